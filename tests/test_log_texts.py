"""Texts of numbers: cells that are none are named with their row, what no one needs stops nothing, and memory is
bounded."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest

from ident.cli import main
from ident.convert import convert_logs
from ident.convert.cells import Cells
from ident.convert.guess import guess_map
from ident.convert.guess_text import period_of
from ident.convert.reading import list_signals, read_log, survey_log
from robot_assets.errors import DataError

N = 3000
X = np.round(np.sin(np.arange(N) / 50.0), 6)
MAP = 'sample_rate = 100.0\n[columns]\ntau_1 = "u"\nq_1 = "x"\n'


def written(folder, rows, header="u,x", above="", name="log.csv"):
    (folder / name).write_text(f"{above}{header}\n" + "".join(f"{r}\n" for r in rows), encoding="utf-8")
    return folder / name


def rows(change=lambda k, row: row, delimiter=","):
    return [change(k, delimiter.join((f"{X[k]}", f"{-X[k]}"))) for k in range(N)]


def converted(log):
    (log.parent / "map.toml").write_text(MAP)
    (s,) = convert_logs([log], "twomass", log.parent / "map.toml").segments
    return s


@pytest.mark.parametrize(
    ("row", "cells", "found"),
    [
        (2000, "0.1,ERR", "x = 'ERR' in row 2001"),
        (2000, "0.1,0x1237", "x = '0x1237' in row 2001"),
        (2000, "u,x", "the header again in row 2001"),
        (0, "0.1,on", "x is no array of numbers but of texts: 'on' in row 1"),
        (2000, "0.1,0.2,0.3", r"found 3 columns in line 2002: '0\.1,0\.2,0\.3', expected 2 as in the rows above"),
        (2000, '0.1,"1,5"', "x = '1,5' in row 2001"),  # points elsewhere: no decimal comma
        (2000, "0.1,nan", r"q_1: .*log\.csv: found NaN of x at sample 2000 \(1 not finite in all\)"),
        (2000, "inf,0.1", r"tau_1: .*log\.csv: found infinity of u at sample 2000"),
        (2000, "0.1,1e40", r"q_1: .*log\.csv: found 1e\+40 of x at sample 2000"),
    ],
)
def test_a_cell_that_cannot_be_used_is_named_with_its_row(tmp_path, row, cells, found):
    log = written(tmp_path, rows(lambda k, text: cells if k == row else text))
    with pytest.raises(DataError, match=found) as caught:
        converted(log)
    assert "\n" not in str(caught.value) and "log.csv" in str(caught.value)


def test_decimal_commas_may_begin_late_and_stand_in_quotes(tmp_path):
    x = np.where(np.arange(N) < 1500, np.round(X), X)
    cells = [f"{v:g}".replace(".", ",") for v in x]
    for log in (
        written(tmp_path, [f"{c};{c}" for c in cells], "u;x", name="semicolons.csv"),
        written(tmp_path, [f'"{c}","{c}"' for c in cells], name="quotes.csv"),
        written(tmp_path, [f"{c}\t{c}" for c in cells], "u\tx", name="tabs.txt"),
        written(tmp_path, [f" {c}   {c}" for c in cells], "u x", name="blanks.txt"),
    ):
        assert np.array_equal(converted(log).q[:, 0], np.array([float(f"{v:g}") for v in x])), log


def test_exponents_of_fortran(tmp_path):
    log = written(tmp_path, [f" {x:.6e}".replace("e", "D") + f",{-x:.6e}".replace("e", "d") for x in X])
    assert np.array_equal(converted(log).q[:, 0], -X)


def test_a_log_of_texts_alone_is_said_to_be(tmp_path):
    with pytest.raises(DataError, match=r"no signal of 20 samples or more \(u has 'a' in row 1\)"):
        guess_map([written(tmp_path, ["a,b"] * 100)], "twomass")


def test_commas_that_part_thousands_are_no_decimal_signs(tmp_path):
    for cell in ("1,234", "1,234,567"):
        log = written(tmp_path, [f'5,"{cell}"'] * 50)
        with pytest.raises(DataError, match=cell):
            converted(log)


@pytest.mark.parametrize(
    ("cell", "value"),
    [("{:,.0f}", np.round(4e4 * X)), ("{:,.3f}", np.round(4e4 * X, 3)), ("{:,.0f}", np.round(4e6 * X)), ("{:.3f}", X)],
)
@pytest.mark.parametrize("decimal", [".", ","])
def test_signs_between_thousands_are_known_by_the_decimal_sign_of_the_log(tmp_path, cell, value, decimal):
    def local(text):
        return text.translate(str.maketrans(",.", ".,")) if decimal == "," else text

    log = written(tmp_path, [f"{local(f'{u:.6f}')};{local(cell.format(x))}" for u, x in zip(X, value)], "u;x")
    assert np.array_equal(converted(log).q[:, 0], np.round(value, 3)) and np.array_equal(converted(log).tau[:, 0], X)
    assert np.array_equal(survey_log(log).signals["x"], np.round(value, 3)) and not survey_log(log).doubts


@pytest.mark.parametrize(("decimal", "other"), [(".", ","), (",", ".")])
def test_a_sign_that_may_be_one_of_thousands_or_of_decimals_is_an_error(tmp_path, decimal, other):
    cells = [f"{k % 90 + 10}{other}{k % 900 + 100}" for k in range(N)]
    log = written(tmp_path, [f"0{decimal}{k % 7};{c}" for k, c in enumerate(cells)], "u;x")
    with pytest.raises(DataError, match=rf"x = '10\{other}100' in row 1, where decimals stand behind '\{decimal}'"):
        converted(log)
    assert survey_log(log).doubts == {"x": f"'10{other}100' in row 1"}
    other_way = written(tmp_path, [f"0{decimal}{k % 7};0{other}{k % 7}" for k in range(N)], "u;x")
    assert np.array_equal(*(getattr(converted(other_way), channel) for channel in ("q", "tau")))


def test_thousands_after_which_decimals_follow_are_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr("ident.convert.texts.PIECE", 1000)  # of the log, which is read piece by piece
    cells = [f"{k}" if k < 1000 else "1.500" if k < 2000 else "0.25" for k in range(N)]
    with pytest.raises(DataError, match=r"x = '0\.25' in row 2001"):
        converted(written(tmp_path, [f"0,{k % 7};{c}" for k, c in enumerate(cells)], "u;x"))


@pytest.mark.parametrize(
    "cell",
    [
        lambda k: "" if k < 2500 else "STOP",
        lambda k: "0x1237",
        lambda k: "0" if k < 2500 else "E12",
        lambda k: "Größe",
        lambda k: "",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_a_column_that_no_one_needs_stops_nothing(tmp_path, cell, encoding):
    text = "u,x,event\n" + "\n".join(rows(lambda k, r: f"{r},{cell(k)}")) + "\n"
    (tmp_path / "log.csv").write_bytes(text.encode(encoding))
    survey = survey_log(tmp_path / "log.csv")
    assert np.array_equal(survey.signals["x"], -X) and set(survey.signals) <= {"u", "x", "event"}
    assert np.array_equal(converted(tmp_path / "log.csv").q[:, 0], -X)


def test_a_damaged_cell_is_told_by_the_survey_which_keeps_its_column(tmp_path):
    survey = survey_log(written(tmp_path, rows(lambda k, r: "0.1,ERR" if k == 2000 else r)))
    assert survey.doubts == {"x": "'ERR' in row 2001"}
    assert np.array_equal(np.flatnonzero(np.isnan(survey.signals["x"])), [2000])


@pytest.mark.parametrize(
    "above", ["Name;Scope\nFile;x.svdx\n\n", "Rate;1000\nCount;5\n\n", "a note\n# more\n", "# a comment\n" * 1100]
)
def test_lines_of_a_program_above_the_header(tmp_path, above):
    log = written(tmp_path, rows(delimiter=";"), "u;x", above)
    assert np.array_equal(converted(log).tau[:, 0], X)


@pytest.mark.parametrize(("header", "end"), [("u,x", ","), ("u,x,", ""), ("u,x,", ",")])
def test_a_delimiter_at_the_end_of_rows_or_of_the_header(tmp_path, header, end):
    assert np.array_equal(converted(written(tmp_path, rows(lambda k, r: r + end), header)).q[:, 0], -X)


def test_a_header_that_is_a_comment_above_rows_with_texts(tmp_path):
    log = written(tmp_path, [f"{k},joint1,{X[k]}" for k in range(N)], "%time,field.name0,field.position0")
    assert sorted(list_signals(log)) == ["field.position0", "time"]
    for name in ("%time", "time"):  # as the file has it, or without its sign
        assert np.array_equal(read_log(log, {name, "field.position0"})[name], np.arange(N))


def test_rows_of_blanks_with_comments_between(tmp_path):
    text = "# nothing\n" + "".join(
        f"  {x}\t {2 * x}  \n" + ("# more\n" if k % 100 == 3 else "") for k, x in enumerate(X)
    )
    (tmp_path / "log.txt").write_text(text)
    assert np.allclose(list_signals(tmp_path / "log.txt")["values"], np.stack([X, 2 * X], axis=1))
    (tmp_path / "named.txt").write_text("u   x\n" + text.split("\n", 1)[1].replace("# more\n", ""))
    assert np.allclose(converted(tmp_path / "named.txt").q[:, 0], 2 * X)


@pytest.mark.parametrize("command", ["convert", "guess"])
def test_texts_that_are_no_numbers_take_no_memory(tmp_path, command):
    """A process of its own, since the memory that one has had does not shrink."""
    (tmp_path / "log.csv").write_text("t,q1\n" + "abc,d\n" * 2_000_000)
    (tmp_path / "map.toml").write_text(MAP)
    what = {
        "convert": f"from ident.convert import convert_logs as f; args = ([Path('{tmp_path}/log.csv')], 'twomass', '{tmp_path}/map.toml')",
        "guess": f"from ident.convert.guess import guess_map as f; args = ([Path('{tmp_path}/log.csv')], 'twomass')",
    }[command]
    code = (
        f"import resource\nfrom pathlib import Path\nfrom robot_assets.errors import DataError\n{what}\n"
        "peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\nbefore = peak()\n"
        "try:\n    f(*args)\nexcept DataError as err:\n    print(err)\nprint(peak() - before)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    error, grown = run.stdout.strip().splitlines()
    assert "log.csv" in error and int(grown) < 20_000, run.stdout  # KB, of a file of 12 MB


def test_the_beginning_of_a_long_log_is_enough_for_a_guess(tmp_path, monkeypatch):
    monkeypatch.setattr("ident.convert.texts.MOST_CELLS", 100_000)
    monkeypatch.setattr("ident.convert.reading.MOST_CELLS", 100_000)
    row = ["0.12345678,0.87654321", "0.2,0.1"]
    log = written(tmp_path, row * 100_000, "torque_Nm,pos_rad")
    survey = survey_log(log)
    assert 50_000 < survey.cut < 150_000 and len(survey.signals["pos_rad"]) == survey.cut
    assert guess_map([log], "twomass").warnings[-1] == f"log.csv: guessed from its first {survey.cut} rows"
    assert len(read_log(log, {"pos_rad"})["pos_rad"]) == 200_000


@pytest.mark.parametrize("quiet", [(), ("--quiet",), ("--json",)])
def test_a_large_log_has_progress(tmp_path, monkeypatch, capfd, quiet):
    (tmp_path / "map.toml").write_text(MAP)
    args = [
        "simgap",
        "convert",
        str(written(tmp_path, rows())),
        "--robot",
        "twomass",
        "--map",
        str(tmp_path / "map.toml"),
        "--out",
        str(tmp_path / "d"),
        *quiet,
    ]
    for size, told in ((1e3, not quiet), (1e9, False)):
        monkeypatch.setattr("ident.cli.LARGE_LOG", size)
        monkeypatch.setattr(sys, "argv", args)
        main()
        assert capfd.readouterr().err.splitlines() == (["reading log.csv", f"writing {tmp_path / 'd'}"] if told else [])


@pytest.mark.parametrize(
    ("cells", "why"),
    [
        (lambda k: "nan", "has no numbers"),
        (lambda k: "on", "has 'on' in row 1"),
        (lambda k: f"{k}.5/3", "has '0.5/3' in row 1"),
    ],
)
def test_columns_that_a_guess_leaves_out_are_told(tmp_path, cells, why):
    log = written(tmp_path, [f"{k / 100};{X[k]};{cells(k)}" for k in range(N)], "t;pos_rad;torque_Nm")
    guessed = guess_map([log], "twomass")
    assert guessed.missing == ("tau",) and guessed.warnings == (f"torque_Nm {why}: not used",)
    assert f"#   torque_Nm: not read, as it {why}" in guessed.text
    twice = written(tmp_path, [f"{X[k]};{X[k]};{-X[k]};{cells(k)}" for k in range(N)], "pos_rad;u_Nm;u_Nm;Zeit")
    warnings = guess_map([twice], "twomass").warnings
    assert (
        f"Zeit {why}: not used" in warnings
        and "u_Nm several columns that differ: the conversion will name it" in warnings
    )


def test_ranges_in_a_guess_are_those_of_the_numbers(tmp_path):
    cells = [f"{k / 100};{X[k]};{'nan' if k % 100 == 0 else 20 + X[k]}" for k in range(N)]
    assert "# tau: 19 to 21" in guess_map([written(tmp_path, cells, "t;pos_rad;torque_Nm")], "twomass").text
    log = written(tmp_path, [c.replace(f";{X[k]};", ";;") for k, c in enumerate(cells)], "t;x;u")
    with pytest.raises(DataError, match="found x without a number in it, expected numbers"):
        converted(log)
    np.savez(tmp_path / "log.npz", log=np.zeros(50, "V8"))
    with pytest.raises(DataError, match=r"log has structures or objects in place of numbers"):
        guess_map([tmp_path / "log.npz"], "twomass")


def test_rows_without_a_number_may_be_left_out(tmp_path):
    with pytest.raises(DataError, match=r"found NaN of x at sample 5 .*rows without may be left out"):
        converted(written(tmp_path, rows(lambda k, r: "0.1,nan" if k == 5 else r)))


@pytest.mark.parametrize("creep", [1e-3, 1.0])
def test_a_joint_that_creeps_hides_no_period_and_makes_none(creep):
    """Beside what the other does it is little, or the motion as a whole does not repeat."""
    rng, t = np.random.default_rng(0), np.arange(20000)
    wave = np.sin(2 * np.pi * t / 1000) + 0.5 * np.sin(6 * np.pi * t / 1000 + 1) + 0.01 * rng.normal(size=len(t))
    drift = creep * np.sin(2 * np.pi * t / (2.2 * len(t)))
    tau, q = np.stack([wave, 0.1 * wave], axis=1), np.stack([0.2 * wave, drift], axis=1)
    found = period_of({"tau": SimpleNamespace(x=tau), "q": SimpleNamespace(x=q)})
    assert found == (1000 if creep < 0.1 else None)


@pytest.mark.parametrize("pieces", [(["1.234", "2.345"], ["500"]), (["500"], ["1.234", "2.345"])])
def test_a_number_below_a_thousand_shows_thousands_in_whichever_piece_it_comes(pieces):
    cells = Cells("q", Path("log.csv"), wanted=True, quoted=False, decimal=",")
    for piece in pieces:
        cells.take(pa.array(piece))
    cells.end()
    assert sorted(cells.array()) == [500.0, 1234.0, 2345.0]


def test_an_empty_piece_says_nothing_of_the_order_of_day_and_month():
    cells = Cells("time", Path("log.csv"), wanted=True, quoted=False)
    for piece in (["11/02/2024 23:59:58"], ["", ""], ["11/03/2024 00:00:01"]):
        cells.take(pa.array(piece))
    found = cells.array()
    assert [str(x)[:10] for x in found[[0, 3]]] == ["2024-11-02", "2024-11-03"]
