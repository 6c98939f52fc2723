"""trials.csv after a spreadsheet had it: read whole, or set aside with a line that says why."""

import csv
import io

import pytest
from conftest import quick_options, settings

from sofnn_torch import training
from sofnn_torch.runs import table

OWN = (
    "trial,steps,reward,success,statistic\n"
    "1,120,-0.0005,False,0.25\n"
    "2,95,0.9998000000000001,True,1e-07\n"
    "3,1120,1.0,True,\n"
)
ROWS = list(csv.reader(io.StringIO(OWN)))


def dump(rows, **style):
    buffer = io.StringIO()
    csv.writer(buffer, **({"lineterminator": "\n"} | style)).writerows(rows)
    return buffer.getvalue()


COMMAS = [ROWS[0]] + [[cell.replace(".", ",") for cell in row] for row in ROWS[1:]]
CAPITALS = [[cell.upper() if cell in ("True", "False") else cell for cell in row] for row in ROWS]
BLANK = [""] * 5
STYLES = {
    "a byte-order mark": "\ufeff" + OWN,
    "quotes": dump(ROWS, quoting=csv.QUOTE_ALL),
    "other line ends": dump(ROWS, lineterminator="\r\n"),
    "semicolons": dump(ROWS, delimiter=";"),
    "tabs": dump(ROWS, delimiter="\t"),
    "semicolons, decimal commas or other cases": dump(COMMAS, delimiter=";"),
    "quotes, decimal commas or other cases": dump(COMMAS),
    "quotes, blank rows": dump([*ROWS[:2], BLANK, *ROWS[2:], BLANK], quoting=csv.QUOTE_ALL),
    "quotes, blank columns": dump([[*row, "", ""] for row in ROWS], quoting=csv.QUOTE_ALL),
    "semicolons, blank columns": dump([[*row[:2], "", *row[2:]] for row in ROWS], delimiter=";"),
    "tabs, decimal commas or other cases": dump(CAPITALS, delimiter="\t"),
    "a byte-order mark, semicolons, other line ends": (
        "\ufeffsep=;\r\n" + dump(ROWS, delimiter=";", lineterminator="\r\n")
    ),
}


def test_the_own_style_is_left_as_it_is():
    assert table.read(OWN.encode()) == (OWN.splitlines(keepends=True), "")


@pytest.mark.parametrize("found", STYLES)
def test_what_a_spreadsheet_makes_of_it_is_read_whole(found):
    lines, said = table.read(STYLES[found].encode())
    assert "".join(lines) == OWN and said == found


FOREIGN = {
    "another table": ("name,age\nann,3\n", "its first line is 'name,age'"),
    "a picture": ("\x89PNG\r\n\x1a\n", "its first line is '\ufffdPNG'"),
    "thousands": (OWN.replace("1120", '"1,120"'), "steps is '1,120'"),
    "scientific": (dump(ROWS, delimiter=";").replace("1120", "1.12E+03"), "steps is '1.12E+03'"),
    "a currency": (dump(ROWS, delimiter=";").replace("0.25", "0.25 €"), "statistic is '0.25 €'"),
    "a remark": (dump([*ROWS, ["4", "1", "1", "True", "1", "good"]], delimiter=";"), "4,1,1,True"),
    "other digits": (
        dump(ROWS, delimiter=";").replace("95", "\u0669\u0665"),
        "steps is '\u0669\u0665'",
    ),
    "open quotes": (OWN.replace("0.25", '"0.25'), "unexpected end of data"),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_what_could_mean_anything_is_refused(kind):
    text, reason = FOREIGN[kind]
    data = b"\x89PNG\r\n\x1a\n" if kind == "a picture" else text.encode()
    with pytest.raises(ValueError) as refusal:
        table.read(data)
    assert reason in str(refusal.value)


@pytest.mark.parametrize("torn", ["4,99", "4,99,1.0\n", "4,99,0,5,True,0,25\n"])
def test_lines_of_other_lengths_are_not_of_the_table(torn):
    assert table.read((OWN + torn).encode()) == (OWN.splitlines(keepends=True), "")


@pytest.mark.parametrize(
    ("row", "number"), [("12,5\n", 12), ("\u0661,5\n", 0), ("1_2,5\n", 0), ("9" * 20, 0), (",5", 0)]
)
def test_the_trial_of_a_line_is_a_plain_number(row, number):
    assert table.number(row) == number


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The table of a run of four trials."""
    run = training.train(settings(), quick_options(tmp_path_factory.mktemp("runs")))
    return (run / "trials.csv").read_bytes()


@pytest.fixture
def stopped(options):
    """A run of two of these trials."""
    return training.train(settings(trials=2), options)


def change(run, text):
    """The table changed from its text; its new bytes."""
    file = run / "trials.csv"
    file.write_bytes(text(file.read_text()).encode())
    return file.read_bytes()


@pytest.mark.parametrize(
    "style",
    [
        lambda text: "\ufeff" + text,
        lambda text: dump(csv.reader(io.StringIO(text)), delimiter=";", lineterminator="\r\n"),
        lambda text: dump(csv.reader(io.StringIO(text)), quoting=csv.QUOTE_ALL),
        lambda text: "".join(text.splitlines(keepends=True)[n] for n in (0, 2, 1)),
    ],
)
def test_a_resumed_run_goes_on_in_its_own_style(style, stopped, options, undisturbed, capsys):
    before = change(stopped, style)
    training.resume(stopped, options, trials=4)
    assert (stopped / "trials.csv").read_bytes() == undisturbed
    assert (stopped / "trials.csv.unused").read_bytes() == before
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"warning: {stopped / 'trials.csv'} has ") and "read whole" in line


def test_a_table_that_cannot_be_continued_is_set_aside(stopped, options, undisturbed, capsys):
    before = change(stopped, lambda text: text.replace("trial,steps", "Versuch;Schritte"))
    training.resume(stopped, options, trials=4)
    header, _, _, *rest = undisturbed.splitlines(keepends=True)
    assert (stopped / "trials.csv").read_bytes() == b"".join([header, *rest])
    assert (stopped / "trials.csv.unused").read_bytes() == before
    (line,) = capsys.readouterr().err.splitlines()
    assert "cannot be continued (its first line is 'Versuch;Schritte" in line


def test_a_table_of_enormous_size_is_set_aside_unread(stopped, options, undisturbed, capsys):
    with open(stopped / "trials.csv", "ab") as file:
        file.truncate(2**40)  # takes no space on the disk
    training.resume(stopped, options, trials=4)
    header, _, _, *rest = undisturbed.splitlines(keepends=True)
    assert (stopped / "trials.csv").read_bytes() == b"".join([header, *rest])
    assert "1,099,511,627,776 bytes are too many" in capsys.readouterr().err
