"""Robots: URDFs and robot.toml."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from tests.hostile import sound
from tests.hostile.case import ACCEPTED, REFUSED, Case

URDF = sound.URDF
LOL = (
    '<!DOCTYPE robot [<!ENTITY a "'
    + "lol" * 100
    + '">'
    + "".join(f'<!ENTITY {b} "{f"&{a};" * 20}">' for a, b in zip("abcdefgh", "bcdefghi"))
    + "]>"
)


def cases() -> Iterator[Case]:
    """All of them."""
    yield from urdfs()
    yield from tomls()


def chain(count: int, kind: str = "revolute") -> str:
    """A URDF of ``count`` joints in a row."""
    body = '<inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial>'
    links = "".join(f'<link name="l{k}">{body}</link>' for k in range(count + 1))
    joints = "".join(
        f'<joint name="j{k}" type="{kind}"><parent link="l{k}"/><child link="l{k + 1}"/><origin xyz="0 0 0.1"/><axis xyz="0 1 0"/>'
        f'<limit lower="-1" upper="1" effort="10" velocity="1"/></joint>'
        for k in range(count)
    )
    return f'<robot name="chain">{links}{joints}</robot>'


def replaced(old: str, new: str) -> str:
    assert old in URDF, old
    return URDF.replace(old, new, 1)


def texts() -> dict[str, tuple[str | bytes, str]]:
    """URDF by what is odd in it, and what comes of it."""
    bad = {
        "empty": "",
        "no XML": "hello",
        "cut": URDF[:300],
        "bytes": bytes(range(256)) * 4,
        "zeros": bytes(500),
        "another root": URDF.replace("robot", "machine"),
        "HTML": "<!DOCTYPE html><html><body></body></html>",
        "no links": '<robot name="r"/>',
        "no joints": '<robot name="r"><link name="a"/></robot>',
        "a link missing": replaced('<link name="a"/>', ""),
        "a child missing": replaced('<child link="c"/>', ""),
        "a child unknown": replaced('<child link="c"/>', '<child link="z"/>'),
        "a parent unknown": replaced('<parent link="b"/>', '<parent link="z"/>'),
        "a joint to itself": replaced('<parent link="b"/><child link="c"/>', '<parent link="c"/><child link="c"/>'),
        "a loop": replaced('<parent link="a"/>', '<parent link="c"/>'),
        "a loop beside the tree": replaced(
            '<parent link="b"/><child link="c"/>', '<parent link="d"/><child link="c"/>'
        ).replace(
            "</robot>",
            '<link name="d"/><joint name="x" type="fixed"><parent link="c"/><child link="d"/></joint></robot>',
        ),
        "two roots": replaced('<link name="a"/>', '<link name="a"/><link name="free"/>'),
        "two parents": URDF.replace(
            "</robot>", '<joint name="x" type="fixed"><parent link="a"/><child link="c"/></joint></robot>'
        ),
        "a link twice": replaced('<link name="a"/>', '<link name="a"/><link name="a"/>'),
        "a joint twice": replaced('name="two"', 'name="one"'),
        "a joint without a name": replaced('name="two" ', ""),
        "a link without a name": replaced('<link name="a"/>', "<link/>"),
        "a joint of no type": replaced('name="two" type="revolute"', 'name="two"'),
        "a floating joint": replaced('name="two" type="revolute"', 'name="two" type="floating"'),
        "a planar joint": replaced('name="two" type="revolute"', 'name="two" type="planar"'),
        "only fixed joints": URDF.replace("revolute", "fixed"),
        "a negative mass": replaced('mass value="3"', 'mass value="-3"'),
        "a mass of NaN": replaced('mass value="3"', 'mass value="nan"'),
        "an infinite mass": replaced('mass value="3"', 'mass value="inf"'),
        "a mass of a word": replaced('mass value="3"', 'mass value="heavy"'),
        "a huge mass": replaced('mass value="3"', 'mass value="1e300"'),
        "no mass": replaced('<mass value="3"/>', ""),
        "no inertia": replaced('<inertia ixx="0.1" iyy="0.1" izz="0.1"/>', ""),
        "a negative inertia": replaced('ixx="0.1"', 'ixx="-0.1"'),
        "an inertia that is none": replaced('ixx="0.1"', 'ixx="0.1" ixy="5"'),
        "a huge inertia": replaced('ixx="0.1"', 'ixx="1e300"'),
        "an axis of zeros": replaced('axis xyz="0 0 1"', 'axis xyz="0 0 0"'),
        "an axis of two": replaced('axis xyz="0 0 1"', 'axis xyz="0 1"'),
        "an axis of words": replaced('axis xyz="0 0 1"', 'axis xyz="x y z"'),
        "an origin of NaN": replaced('origin xyz="0.4 0 0"', 'origin xyz="nan 0 0"'),
        "an origin far away": replaced('origin xyz="0.4 0 0"', 'origin xyz="1e200 0 0"'),
        "limits that cross": replaced('lower="-3" upper="3"', 'lower="3" upper="-3"'),
        "limits of NaN": replaced('lower="-3"', 'lower="nan"'),
        "limits without end": replaced('lower="-3" upper="3"', 'lower="-1e300" upper="1e300"'),
        "entities": LOL + replaced('name="pair"', 'name="&i;"'),
        "entities in UTF-16": (
            '<?xml version="1.0" encoding="UTF-16"?>' + LOL + replaced('name="pair"', 'name="&i;"')
        ).encode("utf-16"),
        "an entity from a file": '<!DOCTYPE robot [<!ENTITY x SYSTEM "file:///etc/passwd">]>'
        + URDF.replace("</robot>", "&x;</robot>"),
        "a DTD from a file": '<!DOCTYPE robot SYSTEM "file:///etc/passwd">' + URDF,
        "an unknown entity": URDF.replace("</robot>", "&nope;</robot>"),
        "an encoding that is none": '<?xml version="1.0" encoding="latin-99"?>' + URDF,
        "nested deeply": URDF.replace("</robot>", "<a>" * 20000 + "</a>" * 20000 + "</robot>"),
        "3000 joints": chain(3000),
        "200 joints": chain(200),
        "20000 links": chain(20000, "fixed"),
        "a name of control characters": replaced('name="one"', 'name="o&#10;ne"'),
    }
    fine = {
        "comments": "<!-- a -->" + URDF,
        "in UTF-16": ('<?xml version="1.0" encoding="UTF-16"?>' + URDF).encode("utf-16"),
        "a byte order mark": b"\xef\xbb\xbf" + URDF.encode(),
        "no limits": re.sub(r"<limit [^>]*>", "", URDF),
        "no axis": re.sub(r"<axis [^>]*>", "", URDF),
        "no inertial at all": re.sub(r"<inertial>.*?</inertial>", "", URDF, flags=re.S),
        "efforts of words": URDF.replace('effort="80"', 'effort="strong"'),
        "a mesh with dots": URDF.replace(
            '<link name="a"/>',
            '<link name="a"><visual><geometry><mesh filename="../../../etc/passwd"/></geometry></visual></link>',
        ),
        "names in other letters": URDF.replace('"one"', '"jöint µ 1"'),
        "90 joints": chain(90),
        "a name with quotes": replaced('name="one"', "name='o\"n]e'"),
    }
    return {k: (v, REFUSED) for k, v in bad.items()} | {k: (v, ACCEPTED) for k, v in fine.items()}


def urdfs() -> Iterator[Case]:
    for name, (content, outcome) in texts().items():

        def make(folder: Path, content=content) -> list[str]:
            (folder / "arm.urdf").write_bytes(content if isinstance(content, bytes) else content.encode())
            return ["robot", str(folder / "arm.urdf"), "--out", str(folder / "out")]

        yield Case(f"URDF {name}", make, "arm.urdf", outcome)
    for name, outcome in {
        "a\nb.urdf": REFUSED,
        "\udcff.urdf": REFUSED,
        "...": ACCEPTED,
        "größe.urdf": ACCEPTED,
        "robot.toml": REFUSED,
    }.items():

        def named(folder: Path, name=name) -> list[str]:
            (folder / name).write_text(URDF)
            return ["robot", "--out", str(folder / "out"), "--", str(folder / name)]

        yield Case(f"URDF called {name!a}", named, "", outcome)
    for lock in ("one=nan", "one=1e300", "one=x", "nine", "=", "one=", "\x1b[2J", "one=0=0"):

        def locked(folder: Path, lock=lock) -> list[str]:
            (folder / "arm.urdf").write_text(URDF)
            return ["robot", str(folder / "arm.urdf"), "--out", str(folder / "out"), "--lock", lock]

        yield Case(f"URDF locked {lock!a}", locked, "--lock")


TOML = {  # what is replaced in robot.toml, and by what
    "empty": (r"(?s).*", ""),
    "cut": (r"(?s)\[\[joint\]\].*", "[[joi"),
    "a mass of words": (r"motor_inertia = \S+", 'motor_inertia = "big"'),
    "NaN": (r"stiffness = \S+", "stiffness = nan"),
    "negative": (r"stiffness = \S+", "stiffness = -5.0"),
    "zero": (r"damping = \S+", "damping = 0.0"),
    "infinite": (r"torque_limit = \S+", "torque_limit = inf"),
    "a key missing": (r"motor_inertia = .*", ""),
    "another joint": (r'name = "one"', 'name = "nine"'),
    "a joint twice": (r'name = "one"', 'name = "two"'),
    "a URDF outside": (r'file = "pair.urdf"', 'file = "/etc/passwd"'),
    "a URDF that is not there": (r'file = "pair.urdf"', 'file = "nothing.urdf"'),
    "a URDF with a null": (r'file = "pair.urdf"', 'file = "a\\\\u0000b"'),
    "a package unknown": (r'file = "pair.urdf"', 'file = "x.urdf"\npackage = "../../.."'),
    "gravity of two": (r"gravity = .*", "gravity = [0, 0]"),
    "a huge gravity": (r"gravity = .*", "gravity = [0, 0, 1e300]"),
    "a payload nowhere": (r"payload_link = \S+", 'payload_link = "moon"'),
}


def tomls() -> Iterator[Case]:
    for name, (old, new) in TOML.items():

        def make(folder: Path, old=old, new=new) -> list[str]:
            (folder / "log.csv").write_bytes(sound.log_bytes(".csv"))
            args = sound.convert(folder, "log.csv")
            toml = folder / "pair" / "robot.toml"
            text, count = re.subn(old, new, toml.read_text(), count=1)
            assert count
            toml.write_text(text)
            return args

        yield Case(f"robot.toml {name}", make, "passwd" if "outside" in name else "robot.toml")

    def same(folder: Path) -> list[str]:
        args = sound.convert(folder, "pair/robot.toml")
        return args

    yield Case("a robot for a log", same, "robot.toml")
