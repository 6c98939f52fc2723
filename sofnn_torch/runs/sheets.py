"""Tables of numbers in the text files that spreadsheets and editors write.

A spreadsheet keeps the numbers of a CSV file and may change all around them: encoding, delimiter,
quotes, decimal sign, order of the columns, capitals, blank rows and columns. All of that is read.
What could be read in two ways is refused.
"""

import codecs
import csv
import json
import re
from collections.abc import Iterator, Sequence
from typing import Any

from sofnn_torch.numerals import decimal

MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f]")  # in no text, but in every binary file
HINT = re.compile(r'\s*"?sep=.{1,9}\n', re.IGNORECASE)  # a line that tells Excel the delimiter
LINE = re.compile(r"[^\n]+\n?")  # an empty one has no cell
DELIMITERS = ",;\t"
MOST_COLUMNS = 16_384  # of a spreadsheet
THOUSANDS = re.compile(r"[+-]?[1-9][0-9]{0,2}(,[0-9]{3})+")


def decode(data: bytes) -> str:
    r"""Text in UTF-8, in UTF-16 with a byte-order mark, or else in Latin-1; its lines end in \n.

    Names and numbers are ASCII, which is the same in all the old encodings. So a file in one of
    them is read with other letters in its comments, which nobody reads.

    Raises:
        ValueError: not a text.
    """
    try:
        text = data.decode("utf-16" if data.startswith(MARKS) else "utf-8")
    except UnicodeDecodeError as error:
        if error.encoding != "utf-8":
            raise ValueError("not a text file (damaged UTF-16)") from None
        text = data.decode("latin-1")
    if found := CONTROL.search(text):
        raise ValueError(f"not a text file (it has a character U+{ord(found[0]):04X})")
    return text.lstrip("\ufeff").replace("\r\n", "\n").replace("\r", "\n")


def numbers(text: str, names: Sequence[str], most: int) -> list[list[float]]:
    """The rows below a line of column names, in the order of the names; blank rows do not count.

    Args:
        text: of a CSV file, as `decode` returns it.
        names: of the columns to read; others are ignored.
        most: rows. One more is read, so that the caller sees that there are more.

    Raises:
        ValueError: one line that says what was found where.
    """
    try:
        return _numbers(text, names, most)
    except csv.Error as error:
        raise ValueError(f"not CSV ({error})") from None


def _numbers(text: str, names: Sequence[str], most: int) -> list[list[float]]:
    if hint := HINT.match(text):
        text = text[hint.end() :]
    rows = _rows(text, _delimiter(text, names))
    header, table = next(rows, []), []
    places = [_place(name, header) for name in names]
    for number, row in enumerate(rows, 1):
        if len(row) < len(header) or any(row[len(header) :]):
            raise ValueError(f"rule {number}: {len(row)} cells, the first line has {len(header)}")
        table.append([row[place] for place in places])
        if number > most:
            break
    commas = _has_decimal_commas(table)
    return [
        [_number(cell, commas, f"rule {i}, {n}") for n, cell in zip(names, row, strict=True)]
        for i, row in enumerate(table, 1)
    ]


def _rows(text: str, delimiter: str, strict: bool = True) -> Iterator[list[str]]:
    """The rows that are not blank, without the blanks around their cells."""
    lines = _narrow(text, delimiter)
    for row in csv.reader(lines, delimiter=delimiter, skipinitialspace=True, strict=strict):
        cells = [cell.strip() for cell in row]
        if any(cells):
            yield cells


def _narrow(text: str, delimiter: str) -> Iterator[str]:
    """The lines of a text, none of which takes much memory as a list of cells."""
    for line in LINE.finditer(text):
        if line[0].count(delimiter) >= MOST_COLUMNS:
            raise ValueError(f"a line has more than {MOST_COLUMNS:,} cells")
        yield line[0]


def _delimiter(text: str, names: Sequence[str]) -> str:
    """The delimiter with which most names stand in the first line."""
    wanted = {_plain(name) for name in names}

    def known(delimiter: str) -> int:
        header = next(_rows(text, delimiter, strict=False), [])
        return len(wanted.intersection(map(_plain, header)))

    return max(DELIMITERS, key=known)


def _place(name: str, header: Sequence[str]) -> int:
    """Where a column is: the one of that name, or else with other capitals and blanks."""
    for form in (str, _plain):
        places = [i for i, cell in enumerate(header) if form(cell) == form(name)]
        if len(places) == 1:
            return places[0]
        if places:
            raise ValueError(f"column {name} is there twice")
    raise ValueError(f"column {name} is missing; the first line is {show(','.join(header))}")


def _plain(name: str) -> str:
    return "_".join(name.lower().split())


def _has_decimal_commas(table: Sequence[Sequence[str]]) -> bool:
    """Whether all numbers are written with commas, and one is certainly not of thousands."""
    cells = [cell for row in table for cell in row]
    if any("." in cell for cell in cells):
        return False
    return any("," in cell and not THOUSANDS.fullmatch(cell) for cell in cells)


def _number(cell: str, commas: bool, where: str) -> float:
    try:
        return decimal(cell.replace(",", ".") if commas else cell)
    except ValueError:
        hint = " (a decimal comma or a thousands separator?)" if "," in cell else ""
        raise ValueError(f"{where}: must be a number, got {show(cell)}{hint}") from None


def show(value: Any) -> str:
    """A value from a file, in a few characters of one line."""
    if isinstance(value, list | dict):
        return "a list" if isinstance(value, list) else "an object"
    if isinstance(value, float):
        return f"{value:g}"
    return json.dumps(value[:60] if isinstance(value, str) else value)[:70]
