"""The lines of trials.csv, also of one that a spreadsheet had in between.

In the file's own style a line ends with a line feed, cells are separated by commas and nothing is
quoted. What other programs make of that is read as long as it can only mean one thing.
"""

import csv
import dataclasses
import io
import os
import re
from collections.abc import Iterable
from pathlib import Path

from sofnn_torch.progress import say
from sofnn_torch.runs import checkpoint
from sofnn_torch.runs.trial import TrialRecord

WHOLE = {field.name for field in dataclasses.fields(TrialRecord) if field.type is int}
WHOLE_NUMBER = re.compile(r"-?[0-9]+")
DECIMAL_COMMA = re.compile(r"(-?[0-9]+),([0-9]+(?:[eE][+-]?[0-9]+)?)")
NUMBER = re.compile(r"-?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?|-?inf|nan|True|False|")
SEPARATORS = {",": "", ";": "semicolons", "\t": "tabs"}
LONGEST = 2**11  # bytes of a line
LARGEST = 2**28  # bytes of a file


def read(data: bytes) -> tuple[list[str], str]:
    """The lines of a trial table.

    Args:
        data: the file.

    Returns:
        The lines in the file's own style, the header first and without torn ones, and what was
        found that is not of this style, for people; empty if nothing was.

    Raises:
        ValueError: what was found that could mean anything.
    """
    text = data.decode(errors="replace")
    if re.match(r"trial(,[^\"\r\n]+)?(\n|$)", text) and not re.search(r'[\r"]', text):
        lines = [line for line in text.splitlines(keepends=True) if line.endswith("\n")]
        cells = [line.count(",") for line in lines]
        return [line for line, n in zip(lines, cells, strict=True) if n == cells[0]], ""
    return _foreign(text) if text.strip() else ([], "")


def take(file: Path, trial: int, trials: int) -> list[str]:
    """The lines of the first trials of a file, the header first; the rest is left out.

    A file that cannot be continued as it is is set aside, and one line says why.

    Args:
        file: the table, which need not exist.
        trial: the last trial to take.
        trials: lines that the file may have.

    Raises:
        OSError: the file cannot be read or set aside.
    """
    aside = file.with_name(f"{file.name}.unused")
    try:
        data = checkpoint.read_file(file, min(LARGEST, LONGEST * (trials + 32)))
        lines, found = read(data)
    except FileNotFoundError:
        data, lines, found = b"", [], ""
    except ValueError as error:
        os.replace(file, aside)
        say(f"warning: {file} cannot be continued ({error}): set aside as {aside.name}")
        return []
    expected = [*range(1, trial + 1)]
    known = [row for row in lines[1:] if number(row) in range(1, trial + 1)]
    if sorted(map(number, known)) == expected != [number(row) for row in known]:
        known, found = sorted(known, key=number), found or "another order"
    if len(known) != trial:
        say(f"warning: {file} lacks trials before {trial + 1}; see {aside.name}")
    elif found:
        say(f"warning: {file} has {found}: read whole; as it was it is in {aside.name}")
    if found or len(known) != trial:
        aside.write_bytes(data)
    return [*lines[:1], *known]


def line(cells: Iterable[object]) -> str:
    """A line of the table."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerow(cells)
    return buffer.getvalue()


def number(row: str) -> int:
    """The trial of a line, from 1; 0 if it has none."""
    first = row.partition(",")[0]
    return int(first) if re.fullmatch("[0-9]{1,19}", first) else 0


def _foreign(text: str) -> tuple[list[str], str]:
    """The lines of a table in another style, and what that is."""
    plain = text.removeprefix("\ufeff")
    plain = re.sub(r"\Asep=.\r?\n", "", plain)
    head = re.split(r"[\r\n]", plain, maxsplit=1)[0]
    separator = next((s for s in SEPARATORS if _cells(head, s)[0] == "trial"), None)
    if separator is None:
        raise ValueError(f"its first line is {head[:40]!r}")
    found = {
        "a byte-order mark": text.startswith("\ufeff"),
        SEPARATORS[separator]: True,
        "quotes": '"' in plain,
        "other line ends": "\r" in plain,
    }
    try:
        rows = list(csv.reader(io.StringIO(plain, newline=""), delimiter=separator, strict=True))
    except csv.Error as error:
        raise ValueError(str(error)) from None
    rows = [[cell.strip() for cell in row] for row in rows]
    filled = [row for row in rows if any(row)]
    named = [bool(name) for name in filled[0]]
    found["blank rows"], found["blank columns"] = len(filled) < len(rows), not all(named)
    header, *table = (_named(row, named) for row in filled)
    before = str(table)
    table = [[_cell(*pair) for pair in zip(header, row, strict=True)] for row in table]
    found["decimal commas or other cases"] = str(table) != before
    said = ", ".join(what for what, there in found.items() if what and there)
    return [line(row) for row in (header, *table)], said


def _cells(text: str, separator: str) -> list[str]:
    return [*next(csv.reader([text], delimiter=separator), []), ""]


def _named(row: list[str], named: list[bool]) -> list[str]:
    """The cells of the columns that have a name."""
    row = row + [""] * (len(named) - len(row))
    if any(row[len(named) :]) or any(c for c, n in zip(row, named, strict=False) if not n):
        raise ValueError(f"line {','.join(row)[:40]!r} has a cell without a column")
    return [cell for cell, has_name in zip(row, named, strict=False) if has_name]


def _cell(name: str, text: str) -> str:
    """A number as Python writes it."""
    if name in WHOLE and WHOLE_NUMBER.fullmatch(text):
        return text
    decimal = DECIMAL_COMMA.sub(r"\1.\2", text) if DECIMAL_COMMA.fullmatch(text) else text
    decimal = decimal.title() if decimal.lower() in ("true", "false") else decimal
    if name in WHOLE or not NUMBER.fullmatch(decimal):
        raise ValueError(f"{name} is {text[:40]!r}")
    return decimal
