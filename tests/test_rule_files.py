"""Rule files that spreadsheets saved: the same table, or refused with one clear line."""

import csv
import io
import json
import re
import tracemalloc

import numpy as np
import pytest
from conftest import SLOW, parameters
from hypothesis import given
from hypothesis import settings as trials_of
from hypothesis import strategies as st

from sofnn_torch.runs import rule_files, sheets


@pytest.fixture(scope="module")
def sheet(few):
    """Cells of a rule file with comments, its table, and the schema."""
    agent = few[1]
    kind, table = rule_files.schema(agent), parameters(agent)[:6]
    comments = {"usage": [0.1] * 6, "text": ['about 150 ± 60 mm, "left"; 90°'] * 6}
    rows = list(csv.reader(io.StringIO(rule_files.to_csv(kind, table, comments).decode())))
    return rows, table, kind


def dump(rows, **style):
    made = io.StringIO()
    csv.writer(made, **{"lineterminator": "\n"} | style).writerows(rows)
    return made.getvalue()


def commas(rows):
    return [rows[0], *([cell.replace(".", ",") for cell in row] for row in rows[1:])]


def blanks_around(rows):
    return [["", *row, "", ""] for row in [[""] * len(rows[0]), *rows, [" "] * len(rows[0])]]


def beside(rows, *cells):
    return [[*row, *cells] for row in rows]


def reversed_columns(rows):
    return [row[::-1] for row in rows]


def scientific(row):
    return [f"{cell}E+00" if re.fullmatch(r"-?\d+\.\d+", cell) else cell for cell in row]


def title(rows):
    return [[f" {cell.replace('_', ' ').title()} " for cell in rows[0]], *rows[1:]]


SHEETS = {
    "rows cleared at the end": lambda rows: dump([*rows, [""] * len(rows[0]), []]),
    "a row cleared in the middle": lambda rows: dump([*rows[:3], [""] * len(rows[0]), *rows[3:]]),
    "a row of blanks": lambda rows: dump(rows) + "   \n",
    "blank rows and columns": lambda rows: dump(blanks_around(rows)),
    "cells cleared beyond the table": lambda rows: dump([rows[0], *beside(rows[1:], "", "")]),
    "notes beside the table": lambda rows: dump([[*rows[0], ""], *beside(rows[1:], "mine")]),
    "columns moved": lambda rows: dump(reversed_columns(rows)),
    "capitals and blanks": lambda rows: dump(title(rows)),
    "a comment named like a column": lambda rows: dump([[*rows[0], "Mu"], *beside(rows[1:], "1")]),
    "blanks after commas": lambda rows: dump(rows, quoting=csv.QUOTE_ALL).replace('","', '", "'),
    "every cell quoted": lambda rows: dump(rows, quoting=csv.QUOTE_ALL),
    "semicolons": lambda rows: dump(rows, delimiter=";"),
    "tabs": lambda rows: dump(rows, delimiter="\t"),
    "decimal commas": lambda rows: dump(commas(rows)),
    "semicolons and decimal commas": lambda rows: dump(commas(rows), delimiter=";"),
    "a line sep=": lambda rows: "sep=;\n" + dump(rows, delimiter=";"),
    "old line ends": lambda rows: dump(rows, lineterminator="\r"),
    "a byte-order mark": lambda rows: dump(rows).encode("utf-8-sig"),
    "two byte-order marks": lambda rows: ("\ufeff" + dump(rows)).encode("utf-8-sig"),
    "Unicode text of Excel": lambda rows: dump(rows, delimiter="\t", lineterminator="\r\n").encode(
        "utf-16"
    ),
    "big-endian UTF-16": lambda rows: ("\ufeff" + dump(rows)).encode("utf-16-be"),
    "ANSI text of Excel": lambda rows: dump(rows, delimiter=";").encode("cp1252"),
    "exponents": lambda rows: dump([rows[0], *map(scientific, rows[1:])]),
}


@pytest.mark.parametrize("name", SHEETS)
def test_a_table_that_a_spreadsheet_wrote_is_the_same_table(sheet, tmp_path, name):
    rows, table, kind = sheet
    text, file = SHEETS[name](rows), tmp_path / "Rules.CSV"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    assert rule_files.read(file, kind).tobytes() == table.tobytes()


CELLS = {
    "-0.25": -0.25,
    "+0.5": 0.5,
    ".5": 0.5,
    "1.": 1.0,
    " 1": 1.0,
    "1 ": 1.0,
    "\xa01\t": 1.0,
    "1E-3": 0.001,
    "25e-2": 0.25,
    "0007": 7.0,
    "1e-400": 0.0,
    **dict.fromkeys(
        ["", "1_000", "١٢", "\uff11", "0x10", "1e400", "-1e999", "nan", "inf", "Infinity"]
    ),
    **dict.fromkeys(["TRUE", "1,5", "1,500", "1.234,5", "1 000", "1'000", "1.Mar", "01.03.2024"]),
    **dict.fromkeys(
        ["50%", "1/2", "=0.5", "'1", "--1", "- 1", "\u22121", "1e", "e5", ".", "1.2.3"]
    ),
    **dict.fromkeys(["1e5.0", "#REF!", "1f", "1 m", "one", "1\n2"]),
}


@pytest.mark.parametrize("cell", CELLS)
def test_only_plain_numbers_are_numbers(sheet, tmp_path, cell):
    rows, table, kind = sheet
    rows, expected = [list(row) for row in rows], CELLS[cell]
    column = rows[0].index("value")
    rows[2][column] = cell
    (tmp_path / "rules.csv").write_text(dump(rows), encoding="utf-8")
    if expected is None:
        with pytest.raises(ValueError) as error:
            rule_files.read(tmp_path / "rules.csv", kind)
        hint = " (a decimal comma or a thousands separator?)" if "," in cell else ""
        assert str(error.value).endswith(
            f"rules.csv: rule 2, value: must be a number, got {json.dumps(cell.strip())}{hint}"
        )
    else:
        found = rule_files.read(tmp_path / "rules.csv", kind)
        assert found[1, kind.columns.index("value")] == np.float32(expected)
        table = np.delete(table, 1, 0)
        assert np.delete(found, 1, 0).tobytes() == table.tobytes()


def test_commas_that_may_part_thousands_are_refused():
    for cells, read in {
        ("1,500", "2"): None,
        ("1,500", "0,5"): [1.5, 0.5],
        ("1,5", "2"): [1.5, 2],
    }.items():
        text = dump([["a", "b"], cells], delimiter=";")
        if read is None:
            with pytest.raises(ValueError, match=r'rule 1, a: .+ "1,500" \(a decimal comma or'):
                sheets.numbers(text, ["a", "b"], 5)
        else:
            assert sheets.numbers(text, ["a", "b"], 5) == [read]


def test_columns_that_differ_in_capitals_only_are_told_apart():
    assert sheets.numbers("X,x\n1,2\n", ["x", "X"], 5) == [[2, 1]]


LARGE = 2**20
HOSTILE = {
    "columns": (".csv", b"," * LARGE, "a line has more than 16,384 cells"),
    "a row": (".csv", b"%s\n" + b"," * LARGE, "a line has more than 16,384 cells"),
    "other delimiters": (".csv", b"%s\n" + b";" * LARGE, "not CSV (field larger than"),
    "a cell": (".csv", b"%s\n1," + b"9" * LARGE, "not CSV (field larger than field limit"),
    "a name": (".csv", b"a" * LARGE, "not CSV (field larger than field limit"),
    "an open quote": (".csv", b'%s\n"' + b"1\n" * (LARGE // 2), "not CSV (field larger"),
    "rules": (".csv", b"%s\n" + b"1,0,0,0,1,1,1,0,1,0,0,t\n" * (LARGE // 24), "more than 60 rules"),
    "blank rows": (".csv", b"%s" + b"\n" * LARGE, "0 rules"),
    "lists": (".json", b"[[]" + b",[]" * (LARGE // 3) + b"]", "more than"),
    "objects": (".json", b"[" + b'{"":0},' * (LARGE // 7), "more than"),
    "numbers": (".json", b"[1" + b",1" * (LARGE // 2) + b"]", "more than"),
    "digits": (".json", b"[" + b"9" * LARGE + b"]", "not a rule file"),
    "depth": (".json", b"[" * 3000, "nested too deeply"),
    "text": (".json", b'"' + b"\\u0041" * (LARGE // 6) + b'"', "not a rule file"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_small_hostile_file_takes_little_memory(sheet, tmp_path, name):
    rows, _, kind = sheet
    suffix, data, message = HOSTILE[name]
    file = tmp_path / f"rules{suffix}"
    file.write_bytes(data.replace(b"%s", ",".join(rows[0]).encode()))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError) as error:
            rule_files.read(file, kind)
        assert tracemalloc.get_traced_memory()[1] < 8 * LARGE
    finally:
        tracemalloc.stop()
    assert message in str(error.value) and len(str(error.value).splitlines()) == 1


@st.composite
def saved(draw, rows):
    """A table as some spreadsheet could save it, and which slip was made in it."""
    rows, width = [list(row) for row in rows], len(rows[0])
    decimal = draw(st.sampled_from(".,"))
    rows[1:] = [[cell.replace(".", decimal) for cell in row] for row in rows[1:]]
    slip = draw(st.sampled_from([None, None, "sign", "thousands", "lost", "cut"]))
    row, column = draw(st.integers(1, len(rows) - 1)), draw(st.integers(0, width - 1))
    cell = rows[row][column]
    if slip == "sign":
        rows[row][column] = cell.translate({44: ".", 46: ","})
    elif slip == "thousands":
        rows[row][column] = f"1{'.,'.replace(decimal, '')}{cell}"
    elif slip == "lost":
        del rows[row][column]
    elif slip == "cut":
        rows[row] = rows[row][: max(column, 1)]
    if slip not in ("lost", "cut"):
        order = draw(st.permutations(range(width)))
        rows = [[row[place] for place in order] for row in rows]
    for place in draw(st.lists(st.integers(0, len(rows)), max_size=3)):
        rows.insert(place, draw(st.sampled_from([[], [""] * width, [" "], ["", ""] * width])))
    left, right = draw(st.integers(0, 2)), draw(st.integers(0, 2))
    rows = [[""] * left + row + [""] * right for row in rows]
    text = dump(
        rows,
        delimiter=draw(st.sampled_from(",;\t")),
        quoting=draw(st.sampled_from([csv.QUOTE_MINIMAL, csv.QUOTE_ALL, csv.QUOTE_NONNUMERIC])),
        lineterminator=draw(st.sampled_from(["\n", "\r\n", "\r"])),
    )
    if draw(st.booleans()):
        text = "sep=,\n" + text
    return text.encode(draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]))), slip


def test_whatever_a_spreadsheet_saves_is_the_same_table_or_refused(sheet, tmp_path):
    rows, table, kind = sheet
    file, outcomes = tmp_path / "rules.csv", {"same": 0, "refused": 0}

    @trials_of(max_examples=150, deadline=None, database=None, suppress_health_check=SLOW)
    @given(saved(rows))
    def attempt(drawn):
        data, slip = drawn
        file.write_bytes(data)
        try:
            assert rule_files.read(file, kind).tobytes() == table.tobytes()
            outcomes["same"] += 1
        except ValueError as error:
            assert slip and len(str(error).splitlines()) == 1 and len(str(error)) < 300
            outcomes["refused"] += 1

    attempt()
    assert min(outcomes.values()) > 20, outcomes
