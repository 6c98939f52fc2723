"""The data of a study in memory, what is told of its arms, and tables in Markdown."""

import csv
import io
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sofnn_torch.maze.layouts import STANDARD
from sofnn_torch.numerals import decimal
from sofnn_torch.studies.statistics import Measured, median, share

NEVER = 1e15  # what a run that never gets there takes
MOST = 1e9  # more than any other takes, and less than a mean with it


@dataclass(frozen=True)
class Data:
    """The data of one study: the summary, a row for each run, and the other tables by name."""

    info: dict[str, Any]
    rows: list[dict[str, Any]]
    tables: dict[str, list[dict[str, Any]]]

    @property
    def layout(self) -> str:
        """The maze of the runs."""
        arms = self.info["arms"].values()
        return next((arm["config"]["maze"].get("layout", STANDARD) for arm in arms), STANDARD)

    def arms(self) -> list[str]:
        """The arms that have finished runs, those of equal settings but once."""
        seen: list[Any] = []
        names = []
        for name, arm in self.info["arms"].items():
            if (same := [arm["config"], arm["seeds"]]) not in seen:
                seen.append(same)
                names.append(name)
        return names

    def column(self, arm: str, column: str) -> NDArray[np.float64]:
        """A column over the seeds of an arm; empty if the arm has no run."""
        return np.array([_number(row[column]) for row in self.rows if row["arm"] == arm], float)

    def has(self, column: str) -> bool:
        """Whether the data has a column; that of earlier versions lacks some."""
        return column in self.rows[0]

    def diverged(self, *arms: str) -> int:
        """How many runs of the arms diverged."""
        return sum(row["arm"] in arms and row["status"] == "diverged" for row in self.rows)

    def remark(self, text: str, *arms: str) -> str:
        """What is said of the arms, and how many of their seeds diverged if any did."""
        if not (count := self.diverged(*arms)):
            return text
        return f"{text}; {count} of {sum(row['arm'] in arms for row in self.rows)} seeds diverged"

    def curves(self, arm: str, quantity: str) -> dict[int, NDArray[np.float64]]:
        """A quantity of every trial, by the seeds of an arm."""
        rows = self.tables.get("curves", [])
        chosen = [row for row in rows if (row["arm"], row["quantity"]) == (arm, quantity)]
        return {row["seed"]: _numbers(row["values"]) for row in chosen}


def read(out: Path, name: str) -> Data:
    """The data of a study in a directory."""
    parts = ("curves", "paths", "conditions")
    files = {part: out / f"{name}-{part}.csv" for part in parts}
    tables = {part: read_table(file) for part, file in files.items() if file.exists()}
    info = json.loads((out / f"{name}.json").read_text())
    return Data(info, read_table(out / f"{name}.csv"), tables)


def read_table(path: Path) -> list[dict[str, Any]]:
    """Rows of a CSV file; what looks like a number is one."""
    with open(path, newline="") as file:
        return [{k: _cell(v) for k, v in row.items()} for row in csv.DictReader(file)]


def _cell(text: str) -> Any:
    try:
        return _number(text)
    except ValueError:
        return text


def _number(cell: Any) -> float:
    """A number, or the text of one; ``nan`` is what a run that never learned has."""
    return math.nan if str(cell) == "nan" else decimal(str(cell))


def _numbers(cell: Any) -> NDArray[np.float64]:
    """The numbers in a cell, between blanks."""
    return np.array([_number(text) for text in str(cell).split()], float)


def write_table(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Rows of equal columns as CSV."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, rows[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    path.write_text(buffer.getvalue())


def learned_after(data: Data, arm: str) -> Measured:
    """Median trials to learn; runs that never learn count as one more than their trials."""
    return median(censored(data, arm))


def censored(data: Data, arm: str) -> NDArray[np.float64]:
    """Trials to learn with one more than all trials for never: medians stay what they are."""
    values, limits = data.column(arm, "trials_to_learn"), data.column(arm, "trials")
    return np.where(np.isnan(values), limits + 1, values)


def until_learned(data: Data, arm: str, quantity: str) -> str:
    """Median of what a run took until it had learned: ``steps``, ``decisions`` or ``replayed``."""
    values = data.column(arm, f"{quantity}_to_learn")
    return cell(median(np.where(np.isnan(values), NEVER, values)))


def success(data: Data, arm: str, policy: str) -> Measured:
    """Share of the evaluation trials of all seeds that reached the goal."""
    episodes = data.info["episodes"]
    return share(np.rint(data.column(arm, f"{policy}_success") * episodes), episodes)


# --------------------------------------------------------------------------------- Markdown


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]], texts: int = 1) -> str:
    """A table; the first columns are texts, the others numbers and flushed right."""
    lines = [head, ["---"] * texts + ["---:"] * (len(head) - texts), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def cell(measured: Measured, digits: int = 0, factor: float = 1, limit: float = math.inf) -> str:
    """A number with its interval, or the values of seeds that are too few for one.

    Above the limit a number is only known to be more.
    """

    def show(value: float) -> str:
        if value > MOST:
            return "never"
        if factor * value > limit:
            return f"> {limit:,.{digits}f}"
        return f"{factor * value + 1e-9:,.{digits}f}"  # halves go up, not to the even number

    if math.isnan(measured.value):
        return "-"
    if len(measured.values) > 1:
        return "; ".join(map(show, measured.values))
    alike = measured.low == measured.high or measured.low > MOST
    if math.isnan(measured.low) or alike:
        return show(measured.value)
    return f"{show(measured.value)} ({show(measured.low)} to {show(measured.high)})"
