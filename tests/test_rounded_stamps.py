"""Time stamps that are coarser than the rows: even rows are put at even times, others stay where their stamps are."""

import tomllib

import numpy as np
import pytest

from ident.convert import convert_logs
from ident.convert.guess import guess_map
from ident.convert.rounding import even_rows
from robot_assets.errors import DataError

N = 4000


def signals(t):
    rng = np.random.default_rng(0)
    q = 0.4 * np.sin(1.3 * t) + 0.1 * np.sin(5.7 * t + 1) + 1e-6 * rng.normal(size=len(t))
    return q, 20 * np.cos(q) + 0.1 * rng.normal(size=len(t))


def written(folder, stamps, q, tau, name="t", form="{:.3f}"):
    rows = "".join(f"{form.format(s)},{x:.9g},{u:.9g}\n" for s, x, u in zip(stamps, q, tau, strict=True))
    (folder / "log.csv").write_text(f"{name},pos_rad,torque_Nm\n{rows}")
    return folder / "log.csv"


def converted(log, text):
    said = []
    (log.parent / "map.toml").write_text(text.replace("split", "# split"))
    (segment,) = convert_logs([log], "twomass", log.parent / "map.toml", say=said.append).segments
    return segment, said


@pytest.mark.parametrize(
    ("rate", "by", "rounding"),
    [(400.0, 1e-3, np.round), (125.0, 1e-2, np.round), (500.0, 1e-2, np.floor), (2000.0, 1e-3, np.floor), (60.0, 1e-2, np.floor), (50.0, 1.0, np.floor)],
)  # fmt: skip
@pytest.mark.parametrize("name", ["t", "time_ms"])
def test_even_rows_under_rounded_stamps_are_taken_as_even(tmp_path, rate, by, rounding, name):
    t = np.arange(N) / rate
    q, tau = signals(t)
    stamps = rounding(t / by + 1e-9) * by
    factor, form = (1.0, "{:.3f}") if name == "t" else (1e3, "{:.0f}")
    log = written(tmp_path, stamps * factor, q, tau, name, form)
    guessed = guess_map([log], "twomass")
    told = f"stamps rounded to {by * 1e3:g} ms"
    assert tomllib.loads(guessed.text)["sample_rate"] == rate and f"EDIT? {told}: {rate:g} Hz" in guessed.text
    segment, said = converted(log, guessed.text)
    assert np.allclose(segment.q[:, 0], q, rtol=0, atol=1e-8) and segment.t[0] == 0.0 and segment.filled is None
    assert said == [f"log.csv: {told}: its {N} rows put at even times, {rate:g} Hz"]
    # Of a slower dataset all rows are filtered, not one of each stamp taken.
    slower, said = converted(log, guessed.text.replace(f"sample_rate = {rate}", f"sample_rate = {rate / 4}"))
    assert "filtered below" in said[1] and np.abs(slower.q[10:-10, 0] - q[::4][10:-10]).max() < 2e-3


def test_samples_lost_under_rounded_stamps_stay_gaps(tmp_path):
    t = np.delete(np.arange(N), [*range(700, 712), 2222]) / 400.0
    q, tau = signals(t)
    log = written(tmp_path, np.round(t, 3), q, tau)
    segment, said = converted(log, guess_map([log], "twomass").text)
    assert "stamps rounded to 1 ms" in said[0] and "2 gaps, 0.0375 s in all" in said[1]
    assert segment.filled.gaps == 2 and np.abs(np.interp(t, segment.t, segment.q[:, 0]) - q).max() < 1e-4


def rows_of(kind):
    rng = np.random.default_rng(1)
    t = np.arange(N) / 1000.0
    slow = np.arange(N // 2) / 100.0
    if kind == "lost samples":
        t = t[np.sort(rng.permutation(N)[30:])]
    elif "gap" in kind:
        t = np.r_[t[:1500], t[1500:] + {"a gap": 0.3, "a short gap": 0.0005}[kind]]
    elif kind == "one of five not logged":
        t = t[np.arange(N) % 5 < 4]
    elif kind == "jitter":
        t = np.sort(t + 3e-4 * rng.normal(size=N))
    elif kind == "events":
        t = np.cumsum(rng.exponential(0.004, N))
    elif kind == "bursts":
        t = t + 1e-3 * (np.arange(N) // 100)
    q, tau = signals(slow if "rows" in kind or "topics" in kind else t)
    if kind == "rows twice":
        return np.repeat(slow, 2), np.repeat(q, 2), np.repeat(tau, 2)
    if kind == "some rows twice":
        pick = np.sort(np.r_[np.arange(N // 2), rng.permutation(N // 2)[: N // 5]])
        return slow[pick], q[pick], tau[pick]
    if kind == "topics that take turns":
        return np.repeat(slow, 2), np.repeat(q, 2), np.repeat(np.r_[0.0, tau], 2)[1:-1]
    return t, q, tau


@pytest.mark.parametrize(
    "kind", ["a gap", "a short gap", "lost samples", "one of five not logged", "jitter", "events", "bursts", "rows twice", "some rows twice", "topics that take turns"]
)  # fmt: skip
@pytest.mark.parametrize("digits", [3, 6])
def test_other_rows_stay_where_their_stamps_are(kind, digits):
    t, q, tau = rows_of(kind)
    assert even_rows(np.round(t, digits), [q, tau]) is None


def test_days_in_a_column_of_their_own_are_no_rounded_clock(tmp_path):
    t = np.arange(N) / 200.0
    q, tau = signals(t)
    assert even_rows(86400.0 * (t > 7), [q, tau]) is None
    clock = [f"23:59:{53 + s:09.6f}" if s < 7 else f"00:00:{s - 7:09.6f}" for s in t]
    rows = (f"2026-02-{1 + (s >= 7)};{c};{x:.9g};{u:.9g}\n" for s, c, x, u in zip(t, clock, q, tau, strict=True))
    (tmp_path / "log.csv").write_text("Date;Time;pos_rad;torque_Nm\n" + "".join(rows))
    read = tomllib.loads(guess_map([tmp_path / "log.csv"], "twomass").text)
    assert read["time"]["source"] == "Time" and read["sample_rate"] == 200.0


def test_rows_of_which_the_guess_takes_a_part_are_told(tmp_path):
    log = written(tmp_path, *rows_of("some rows twice"))
    assert "EDIT? 800 of 2800 rows at the time of the one before" in guess_map([log], "twomass").text


def test_rows_of_a_joint_each_are_an_error_all_the_same(tmp_path):
    t = np.repeat(np.arange(N // 2) / 500.0, 2)
    q = np.stack([np.sin(t[::2]), 2 + np.cos(t[::2])], axis=1).ravel()
    log = written(tmp_path, t, q, 10 * q)
    with pytest.raises(DataError, match="pivot a table of one joint a row"):
        converted(log, guess_map([log], "twomass").text)
