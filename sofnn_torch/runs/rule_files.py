"""Rule files: the rules of a network as JSON or CSV, to read, edit and load (docs/rules.md).

A file holds every number in the shortest form that gives the same bits again. What is read is
plain data and checked to the last number before anybody uses it.
"""

import csv
import io
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sofnn_torch.learners.learner import Learner
from sofnn_torch.runs import sheets
from sofnn_torch.runs.guard import LARGEST, WIDEST, farthest
from sofnn_torch.runs.sheets import show

FORMAT, VERSION = "sofnn-torch rules", 1
SUFFIXES = (".json", ".csv")
TWICE = object()  # key of the name that an object of a JSON file has twice


@dataclass(frozen=True)
class Schema:
    """What a rule of a learner consists of, and what each number may be.

    Attributes:
        agent: ``sga`` or ``q``.
        inputs: name and unit of the n inputs.
        outputs: names of the m consequents.
        low: least value of each column: n centres, n widths, m consequents. Shape: (2n+m,).
        high: greatest value. Shape: (2n+m,).
        counts: least and greatest number of rules.
    """

    agent: str
    inputs: tuple[tuple[str, str], ...]
    outputs: tuple[str, ...]
    low: NDArray[Any]
    high: NDArray[Any]
    counts: tuple[int, int]

    @property
    def columns(self) -> list[str]:
        """Name of each number of a rule, as in a CSV file."""
        inputs = [f"{name}_{unit}".strip("_") for name, unit in self.inputs]
        parts = [f"{part}_{name}" for part in ("centre", "width") for name in inputs]
        return [*parts, *self.outputs]

    @property
    def head(self) -> dict[str, Any]:
        """What a JSON file says before its rules."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "agent": self.agent,
            "inputs": [{"name": name, "unit": unit} for name, unit in self.inputs],
            "outputs": list(self.outputs),
        }

    @property
    def most_bytes(self) -> int:
        """No sensible file is larger: 32 bytes a number, 512 for the comments of a rule."""
        return 2**20 + self.counts[1] * (512 + 32 * len(self.low))


def schema(agent: Learner) -> Schema:
    """The schema of a learner. Bounds are those that the guard or the learner keeps."""
    net = agent.net
    n, m = net.n_inputs, net.n_outputs
    table = net.default_width.cpu().numpy()
    low, high = np.empty(2 * n + m, table.dtype), np.empty(2 * n + m, table.dtype)
    # Degrees in place of radians stand out.
    high[:n] = [axis.period or farthest(axis) for axis in agent.inputs]
    high[n : 2 * n], high[2 * n :] = WIDEST * table, LARGEST
    high = np.nextafter(high, np.zeros_like(high))  # the guard refuses the limit itself
    low[:] = -high
    low[n : 2 * n] = net.min_width
    for row, output in enumerate(agent.outputs, 2 * n):
        low[row], high[row] = max(low[row], output.low), min(high[row], output.high)
    fixed = not net.criterion.grows and net.n_rules > 0 and not net.given
    counts = (net.n_rules, net.n_rules) if fixed else (1, net.max_rules)
    inputs = tuple((axis.name, axis.unit) for axis in agent.inputs)
    outputs = tuple(output.name.replace(" ", "_") for output in agent.outputs)
    return Schema(agent.name, inputs, outputs, low, high, counts)


# ------------------------------------------------------------------------------------- writing


def to_json(kind: Schema, table: NDArray[Any], comments: dict[str, Sequence[Any]]) -> bytes:
    """A JSON file with one rule on a line.

    Args:
        kind: the schema.
        table: one rule in each row. Shape: (K, 2n+m).
        comments: what else to say of each rule; not read again. K values each.
    """
    n, lines = len(kind.inputs), []
    for i, row in enumerate(shortest(table).tolist()):
        rule = {"rule": i + 1, "centre": row[:n], "width": row[n : 2 * n]}
        rule |= {"consequents": row[2 * n :]} | {name: said[i] for name, said in comments.items()}
        lines.append(f"    {json.dumps(rule, ensure_ascii=False)}")
    head, rules = json.dumps(kind.head, indent=2).removesuffix("\n}"), ",\n".join(lines)
    return f'{head},\n  "rules": [\n{rules}\n  ]\n}}\n'.encode()


def to_csv(kind: Schema, table: NDArray[Any], comments: dict[str, Sequence[Any]]) -> bytes:
    """A CSV file with one rule on a line; arguments as `to_json`."""
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow(["rule", *kind.columns, *comments])
    for i, row in enumerate(shortest(table).tolist()):
        lines.writerow([i + 1, *row, *(said[i] for said in comments.values())])
    return text.getvalue().encode()


def shortest(table: NDArray[Any]) -> NDArray[np.float64]:
    """The doubles with the fewest digits that become the same numbers again."""
    short = table.astype(str).astype(np.float64)
    # A decimal close to the middle of two numbers may be rounded twice to the wrong one.
    return np.where(short.astype(table.dtype) == table, short, table)


# ------------------------------------------------------------------------------------- reading


def read(path: Path, kind: Schema) -> NDArray[Any]:
    """The rules of a file, one in each row. Shape: (K, 2n+m).

    Raises:
        ValueError: one line that names the file, and the rule and the number where one is wrong.
    """
    try:
        return parse(text(path, kind.most_bytes), kind, path.suffix.lower() == ".json")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def parse(text: str, kind: Schema, is_json: bool) -> NDArray[Any]:
    """The rules in the text of a file, one in each row. Shape: (K, 2n+m).

    Raises:
        ValueError: one line on what is wrong, with the rule and the number.
    """
    if is_json:
        return _checked(_from_json(text, kind), kind)
    return _checked(sheets.numbers(text, kind.columns, kind.counts[1]), kind)


def put(agent: Learner, table: NDArray[Any]) -> None:
    """Give a learner the rules of a table (K, 2n+m) in the place of all."""
    agent.net.replace_rules(*torch.from_numpy(table).split_with_sizes(agent.net.parts, 1))


def text(path: Path, most: int) -> str:
    """The text of a rule file; its name ends in .json or .csv.

    Raises:
        ValueError: it cannot be read, is no text or has more bytes than `most`.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError("a rule file ends in .json or .csv")
    try:
        if not path.is_file():
            raise ValueError("no such file")
        with open(path, "rb") as file:
            data = file.read(most + 1)
    except OSError as error:
        raise ValueError(f"cannot be read ({error.strerror})") from None
    if len(data) > most:
        raise ValueError(f"larger than {most:,} bytes, more than this run's rules could fill")
    return sheets.decode(data)


def _from_json(text: str, kind: Schema) -> list[list[float]]:
    values = 2**10 + kind.counts[1] * (len(kind.low) + 32)  # with comments and others' entries
    if sum(map(text.count, ",[{")) > values:  # before each value stands one of them
        raise ValueError(f"more than {values:,} values, no rules of this run have that many")
    try:
        # No whole number is too long for a float, and JSON knows no difference.
        data = json.loads(text, parse_int=float, object_pairs_hook=_object)
    except RecursionError:
        raise ValueError("not a rule file (nested too deeply)") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"not JSON ({error})") from None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise ValueError(f'not a rule file: "format" must be "{FORMAT}"')
    version, rules = data.get("version"), data.get("rules")
    if type(version) is not float or version != VERSION:
        raise ValueError(f"version {show(version)}, this program reads version {VERSION}")
    for name in ("agent", "inputs", "outputs"):
        if data.get(name) != kind.head[name]:
            raise ValueError(f"{name} must be {json.dumps(kind.head[name])} for this run")
    if TWICE in data:
        raise ValueError(f"{show(data[TWICE])} is there twice")
    if not isinstance(rules, list):
        raise ValueError(f"rules must be a list, got {show(rules)}")
    n, columns = len(kind.inputs), kind.columns
    fields = {"centre": columns[:n], "width": columns[n : 2 * n], "consequents": columns[2 * n :]}
    return [_rule(rule, f"rule {number}", fields) for number, rule in enumerate(rules, 1)]


def _rule(rule: Any, where: str, fields: dict[str, list[str]]) -> list[float]:
    """The numbers of one rule of a JSON file."""
    if not isinstance(rule, dict):
        raise ValueError(f"{where}: must be an object, got {show(rule)}")
    if TWICE in rule:
        raise ValueError(f"{where}: {show(rule[TWICE])} is there twice")
    row = []
    for field, names in fields.items():
        values = rule.get(field)
        if not isinstance(values, list) or len(values) != len(names):
            got = f"{len(values)} values" if isinstance(values, list) else show(values)
            raise ValueError(f"{where}, {field}: must be a list of {len(names)} numbers, got {got}")
        for name, value in zip(names, values, strict=True):
            if type(value) is not float:
                raise ValueError(f"{where}, {name}: must be a number, got {show(value)}")
        row += values
    return row


def _object(pairs: list[tuple[str, Any]]) -> dict[Any, Any]:
    """A JSON object; a name that it has twice is noted, the later value must not win silently."""
    data: dict[Any, Any] = dict(pairs)
    if len(data) < len(pairs):
        data[TWICE] = Counter(name for name, _ in pairs).most_common(1)[0][0]
    return data


def _checked(table: list[list[float]], kind: Schema) -> NDArray[Any]:
    """The table in the network's precision, if every number lies within its bounds."""
    least, most = kind.counts
    if not least <= len(table) <= most:
        wanted = (
            f"{least} rules, as the fixed network has" if least == most else f"{least} to {most}"
        )
        count = f"more than {most}" if len(table) > most else len(table)
        raise ValueError(f"{count} rules, must be {wanted}")
    exact = np.array(table)
    with np.errstate(over="ignore"):
        rounded = exact.astype(kind.low.dtype)
    good = (kind.low <= rounded) & (rounded <= kind.high)  # no comparison holds for NaN
    if not good.all():
        rule, column = np.argwhere(~good)[0].tolist()
        raise ValueError(
            f"rule {rule + 1}, {kind.columns[column]}: must lie between {kind.low[column]:g} and "
            f"{kind.high[column]:g}, got {exact[rule, column]:g}"
        )
    return rounded
