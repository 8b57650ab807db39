"""Text logs as other programs and countries write them: encodings, typeset numbers, cells with line breaks."""

import itertools
import sys
import time

import numpy as np
import pytest

from ident.cli import main
from ident.convert import convert_logs
from ident.convert.guess import guess_map
from ident.convert.layout import read_layout
from ident.convert.reading import read_log, survey_log
from robot_assets.errors import DataError

N = 400
T = np.arange(N) / 100.0
X = np.round(np.sin(2 * T), 6)
HEADERS = {
    "shift_jis": "時間 [s],モータ位置 [rad],モータトルク [Nm]",
    "gb18030": "时间 [s],电机位置 [rad],电机力矩 [Nm]",
    "big5": "時間 [s],馬達位置 [rad],馬達力矩 [Nm]",
    "euc_kr": "시간 [s],모터 위치 [rad],모터 토크 [Nm]",
    "cp1251": "время [s],положение [rad],момент [Nm]",
}
WESTERN = (
    "Winkel Größe [°],Öldruck",
    "Température [°C],couple à l'arbre [N·m]",
    "ángulo [°],µm/s²",
    "Messung – q,GRÖßE",
)


def written(folder, header, encoding="utf-8", cell=lambda x: f"{x:.6f}", delimiter=","):
    rows = [delimiter.join((f"{t:.2f}", cell(x), cell(-2 * x))) for t, x in zip(T, X, strict=True)]
    (folder / "log.csv").write_bytes("\n".join([header, *rows, ""]).encode(encoding))
    return folder / "log.csv"


def converted(log, text, folder):
    (folder / "map.toml").write_text(text, encoding="utf-8")
    return convert_logs([log], "twomass", folder / "map.toml").segments[0]


def mapped(names, top=""):
    return f'sample_rate = 100.0\n{top}\n[columns]\nq_1 = "{names[1]}"\ntau_1 = "{names[2]}"\n'


@pytest.mark.parametrize("encoding", HEADERS)
def test_an_encoding_that_bytes_do_not_tell_is_asked_for_and_taken_from_the_map(tmp_path, encoding):
    log, names = written(tmp_path, HEADERS[encoding], encoding), HEADERS[encoding].split(",")
    for read in (lambda: guess_map([log], "twomass"), lambda: converted(log, mapped(names), tmp_path)):
        with pytest.raises(DataError, match='no UTF-8, expected encoding = "NAME" in the map, or --encoding') as caught:
            read()
        assert f"'{names[0]}' in {encoding}" in str(caught.value)
    s = converted(log, mapped(names, f'encoding = "{encoding}"'), tmp_path)
    assert np.array_equal(s.q[:, 0], X) and np.array_equal(s.tau[:, 0], -2 * X)
    guessed = guess_map([log], "twomass", encoding=encoding)
    assert f'encoding = "{encoding}"' in guessed.text and f'source = "{names[2]}"' in guessed.text
    assert not guessed.missing
    assert np.array_equal(converted(log, guessed.text.replace("split", "# "), tmp_path).q[:, 0], X)


@pytest.mark.parametrize("encoding", ["cp1252", "latin-1", "utf-8", "utf-8-sig", "utf-16", "utf-32"])
@pytest.mark.parametrize("header", WESTERN)
def test_western_letters_and_marks_tell_the_encoding(tmp_path, header, encoding):
    if encoding == "latin-1" and "–" in header:
        header = header.replace("–", "-")
    log = written(tmp_path, f"{header},t", encoding)
    told = {"latin-1": "cp1252", "utf-8": "utf-8"}.get(encoding, encoding)
    layout = read_layout(log)
    assert layout.encoding == told and not layout.unsure
    assert list(survey_log(log).signals) == [*header.split(","), "t"]
    assert survey_log(log).encoding == ("" if told == "utf-8" else told)


@pytest.mark.parametrize(
    "name",
    ["Drehmoment × 10", "Kraft ½", "[×]", "Temp été", "pää", "a«b»", "§ 3", "q¹", "Rotação", "Öl ¼", "Größe (±1)"],
)
def test_western_signs_and_words_with_few_letters_of_ascii(tmp_path, name):
    log = written(tmp_path, f"t,{name},tau", "cp1252")
    assert list(survey_log(log).signals) == ["t", name, "tau"] and survey_log(log).encoding == "cp1252"


@pytest.mark.parametrize("cell", ["5 × 3", "ÄÜÄ", "‰«»", "位置"])
def test_texts_below_the_names_tell_no_encoding(tmp_path, cell):
    rows = "".join(f"{t},{x},{cell if k else 'a'}\n" for k, (t, x) in enumerate(zip(T, X, strict=True)))
    (tmp_path / "log.csv").write_bytes(
        "t,Größe,note\n".encode("cp1252") + rows.encode("gb18030" if cell == "位置" else "cp1252")
    )
    assert list(survey_log(tmp_path / "log.csv").signals) == ["t", "Größe"]


def test_a_doubtful_name_shows_its_western_reading(tmp_path):
    # The two letters are a common word of Chinese.
    log = written(tmp_path, "t,DREHMOMENT_ÄÜ,tau", "cp1252")
    with pytest.raises(DataError, match=r"'DREHMOMENT_能' in gb18030, .*'DREHMOMENT_ÄÜ' in cp1252"):
        guess_map([log], "twomass")


@pytest.mark.parametrize("end", ["le", "be"])
def test_utf_16_without_a_mark_may_be_stated_by_its_plain_name(tmp_path, end):
    log = written(tmp_path, "t,位置,tau", f"utf-16-{end}")
    for stated in ("", "utf-16", "UTF16", f"utf-16-{end}"):
        assert np.array_equal(read_log(log, {"位置"}, encoding=stated)["位置"], X)


@pytest.mark.parametrize("encoding", ["shift_jis", "gb18030", "big5", "euc_kr"])
def test_characters_of_two_bytes_are_no_western_letters(tmp_path, encoding):
    words = ("角度", "位置", "速度", "電流", "時間", "右", "左", "軸", "力", "度") if encoding != "gb18030" else (
        "角度", "位置", "速度", "电流", "时间", "右", "左", "轴", "力", "矩",
    )  # fmt: skip
    words = ("각도", "위치", "속도", "전류", "시간", "축", "값") if encoding == "euc_kr" else words
    for word, name in itertools.product(words, ("{}", "q{}", "motor{}", "{} [rad]", "J1{}", "motor {}")):
        (tmp_path / "log.csv").write_bytes(f"t,{name.format(word)}\n0,1\n".encode(encoding))
        assert read_layout(tmp_path / "log.csv").unsure, name.format(word)


def test_names_in_ascii_need_no_encoding(tmp_path):
    log = written(tmp_path, "# 測定\nt,q,tau", "shift_jis")
    assert np.array_equal(converted(log, mapped(("t", "q", "tau")), tmp_path).q[:, 0], X)
    assert "q: q" in "".join(f"{k}: {v}" for k, v in guess_map([log], "twomass").found.items())


def test_files_of_a_log_may_have_encodings_of_their_own(tmp_path):
    for name, header, encoding in (("a", "位置", "shift_jis"), ("b", "力矩", "gb18030")):
        (tmp_path / f"{name}.csv").write_bytes("\n".join([f"{header},n", *(f"{x},0" for x in X), ""]).encode(encoding))
    (tmp_path / "map.toml").write_text(
        'sample_rate = 100.0\nencoding = "sjis"\n[files]\na = "a.csv"\nb = { name = "b.csv", encoding = "gbk" }\n'
        '[columns]\nq_1 = "a:位置"\ntau_1 = "b:力矩"\n',
        encoding="utf-8",
    )
    (s,) = convert_logs([tmp_path / "a.csv", tmp_path / "b.csv"], "twomass", tmp_path / "map.toml").segments
    assert np.array_equal(s.q[:, 0], X) and np.array_equal(s.tau[:, 0], X)


@pytest.mark.parametrize(
    ("encoding", "found"),
    [
        ("shift_jisx", "encoding: .*found 'shift_jisx', expected an encoding"),
        ("base64", "encoding: .*found 'base64', expected an encoding"),
        ("utf-8", "encoding: .*found bytes that are no utf-8 in line 1, .*this may be '時間 .s.' in shift_jis"),
        ("utf-16", "encoding: .*found bytes that are no utf-16 in line 1"),
        ("utf-32", "encoding: .*found bytes that are no utf-32 in line 1"),
        ("idna", "encoding: .*found 'idna', expected an encoding"),
    ],
)
def test_an_encoding_that_cannot_be_is_one_clear_error(tmp_path, encoding, found):
    log = written(tmp_path, HEADERS["shift_jis"], "shift_jis")
    with pytest.raises(DataError, match=found) as caught:
        converted(log, mapped(("t", "q", "tau"), f'encoding = "{encoding}"'), tmp_path)
    assert "\n" not in str(caught.value)


def test_the_command_takes_an_encoding_for_a_guess_alone(tmp_path, monkeypatch, capsys):
    log = written(tmp_path, HEADERS["shift_jis"], "shift_jis")

    def simgap(*args):
        monkeypatch.setattr(sys, "argv", ["simgap", "convert", str(log), "--robot", "twomass", *map(str, args)])
        try:
            main()
        except SystemExit as end:
            return end.code
        return 0

    made = tmp_path / "m.toml"
    assert simgap("--guess", "--map", made) == 2 and not made.exists()
    assert simgap("--guess", "--map", made, "--encoding", "nothing") == 2 and not made.exists()
    assert simgap("--guess", "--map", made, "--encoding", "shift_jis") == 0
    assert simgap("--map", made, "--out", tmp_path / "data") == 0
    assert simgap("--map", made, "--out", tmp_path / "more", "--encoding", "shift_jis") == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 3 and error[-1].endswith('expected encoding = "shift_jis" in the map')


@pytest.mark.parametrize("minus", ["-", "\u2212", "\uff0d"])
@pytest.mark.parametrize("between", ["\u00a0", "\u202f", "\u2009", "\u2007", "'", "\u2019", "thousands"])
@pytest.mark.parametrize(("delimiter", "decimal"), [(";", ","), (",", "."), ("\t", "."), (" ", ".")])
def test_typeset_numbers_are_read(tmp_path, minus, between, delimiter, decimal):
    between = {",": ".", ".": ","}[decimal] if between == "thousands" else between

    def cell(x):
        text = f"{1e6 * x:,.2f}".replace(".", "_").replace(",", between).replace("_", decimal).replace("-", minus)
        return f'"{text}"' if delimiter == between else text

    log = written(tmp_path, delimiter.join(("t", "q", "tau")), cell=cell, delimiter=delimiter)
    if decimal == ",":
        cells = (line.partition(";") for line in log.read_text(encoding="utf-8").splitlines(keepends=True))
        log.write_text("".join(t.replace(".", ",") + ";" + x for t, _, x in cells), encoding="utf-8")
    found = read_log(log, {"t", "q", "tau"})
    assert np.array_equal(found["q"], np.round(1e6 * X, 2)) and np.array_equal(found["t"], T)
    survey = survey_log(log)
    assert np.array_equal(survey.signals["tau"], np.round(-2e6 * X, 2)) and not survey.doubts


def test_typeset_numbers_may_begin_late_be_padded_and_have_exponents(tmp_path):
    def cell(x):
        return f"\u00a0{x:.5e}\u00a0".replace("-", "\u2212") if x < -0.5 else f"{x:.5e}"

    found = read_log(written(tmp_path, "t,q,tau", cell=cell), {"q"})
    assert np.allclose(found["q"], X, rtol=1e-5)


@pytest.mark.parametrize("cell", ["1\u00a023", "1\u00a02345", "5\u22123", "\u2212", "\u20135", "12 345"])
def test_what_is_no_typeset_number_is_named_with_row_and_column(tmp_path, cell):
    log = written(tmp_path, "t;q;tau", delimiter=";", cell=lambda x: cell if x == X[137] else f"{x:.6f}")
    with pytest.raises(DataError) as caught:
        read_log(log, {"q"})
    assert f"q = {cell!r} in row 138, expected numbers" in str(caught.value)


def test_a_cell_of_another_encoding_says_how_to_state_it(tmp_path):
    log = written(tmp_path, "t,q,tau")
    log.write_bytes(log.read_bytes() + b"#" * 70_000 + b",0,0\n4.01,1\xa0000,0\n")
    with pytest.raises(DataError, match=r"q = '1\ufffd000' in row 402, expected numbers, and the encoding"):
        read_log(log, {"q"})


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_names_in_quotes_may_have_line_breaks(tmp_path, end):
    rows = "".join(f"{t:.2f},{x},{-x}{end}" for t, x in zip(T, X, strict=True))
    for header, above in (("", ""), ("", f"File,x.csv{end}{end}"), (f"s,rad,Nm{end}", "")):
        text = f'{above}time,"position{end}of the  motor{end} [rad]","torque{end}[Nm]"{end}{header}{rows}'
        (tmp_path / "log.csv").write_bytes(text.encode())
        found = survey_log(tmp_path / "log.csv").signals
        assert list(found) == ["time", "position of the  motor [rad]", "torque [Nm]"]
        assert np.array_equal(found["torque [Nm]"], -X) and len(found["time"]) == N


@pytest.mark.parametrize("piece", [1 << 20, 1000])
def test_cells_in_quotes_may_have_line_breaks(tmp_path, monkeypatch, piece):
    monkeypatch.setattr("ident.convert.texts.PIECE", piece)
    lines = ["t,q,note"]
    lines += [f'{t:.2f},{x},"see\nbelow, ""{k}"""' for k, (t, x) in enumerate(zip(T, X, strict=True))]
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    assert np.array_equal(read_log(tmp_path / "log.csv", {"q"})["q"], X)
    assert np.array_equal(survey_log(tmp_path / "log.csv").signals["t"], T)


@pytest.mark.parametrize("piece", [1 << 20, 1000])
@pytest.mark.parametrize("note", ['3" pipe', "it's", 'a "b'])
def test_quotes_that_belong_to_no_cell_take_no_rows(tmp_path, monkeypatch, piece, note):
    monkeypatch.setattr("ident.convert.texts.PIECE", piece)
    lines = ["t,q,note", *(f"{t:.2f},{x},{note if k % 7 == 0 else ''}" for k, (t, x) in enumerate(zip(T, X)))]
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    assert np.array_equal(read_log(tmp_path / "log.csv", {"q"})["q"], X)


def test_the_readings_of_a_long_name_take_no_time(tmp_path):
    (tmp_path / "log.csv").write_bytes(b"t,q" + b"x" * 60_000 + " 位置\n0,1\n".encode("gb18030"))
    start = time.perf_counter()
    with pytest.raises(DataError, match=r"no UTF-8, .*in gb18030"):
        survey_log(tmp_path / "log.csv")
    assert time.perf_counter() - start < 2.0
