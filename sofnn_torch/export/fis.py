"""A policy as a Sugeno system in a .fis file of MATLAB and Octave, and rules from such a file.

The normalised sum of Gaussian rules is what these tools call Sugeno inference with ``prod`` and
``wtaver``. They know no input that wraps: each rule stands there twice, a turn apart.
"""

import re
from collections import Counter
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sofnn_torch.export.runtime import Policy
from sofnn_torch.runs.rule_files import shortest

MOST_BYTES, MOST_RULES = 2**26, 100_000
ANYWHERE = 1000.0  # ranges of an input: the width of a rule that does not ask for it
SECTION = re.compile(r"\[(system|input|output|rules)(\d*)\]", re.IGNORECASE)
MEMBERSHIP = re.compile(r"""['"](.*?)['"]\s*:\s*['"](\w+)['"]\s*,\s*\[(.*?)\]""")
WANTED = {"type": "sugeno", "andmethod": "prod", "defuzzmethod": "wtaver"}


@dataclass(frozen=True)
class Sugeno:
    """Gaussian rules that conclude linear functions of the inputs.

    Attributes:
        inputs: name, low and high end of the n inputs.
        outputs: names of the m outputs.
        centres: Shape: (K, n).
        widths: Shape: (K, n).
        slopes: of each conclusion along the inputs, and its constant. Shape: (K, m, n + 1).
    """

    inputs: list[tuple[str, float, float]]
    outputs: list[str]
    centres: NDArray[np.float64]
    widths: NDArray[np.float64]
    slopes: NDArray[np.float64]

    def outputs_at(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """What such a tool computes at inputs (B, n). Shape: (B, m)."""
        firing = np.exp(-0.5 * (((x[:, None] - self.centres) / self.widths) ** 2).sum(2))
        one = np.hstack([x, np.ones((len(x), 1))])
        conclusions = np.einsum("kmi,bi->bkm", self.slopes, one)
        return (firing[:, :, None] * conclusions).sum(1) / firing.sum(1)[:, None]


def system(data: dict[str, Any]) -> Sugeno:
    """The rules of a policy, twice where an input wraps. Outputs are means, or values of actions.

    Where the action is an input of the rules, it is one here too, and the output is its value.
    """
    policy, decision = Policy(data), data["decision"]
    n, axes = len(policy.low), list(data["axes"])
    if policy.acting:
        axes.append({"name": "action", "low": -1.0, "high": 1.0, "period": 0.0})
    u, v, c = policy.centres, policy.widths, policy.consequents
    if decision["kind"] == "normal":
        names = data["outputs"][: decision["numbers"]]
        slopes = np.zeros((len(u), len(names), n + 1))
        slopes[:, :, -1] = c[:, : len(names)]
    elif policy.acting:
        names, slopes = ["value"], c[:, None]
    else:
        names = [f"value {name}" for name in data["actions"]]
        if len(names) != len(policy.codes):
            names = [f"value {j + 1}" for j in range(len(policy.codes))]
        slopes = np.repeat(c[:, None, : n + 1], len(names), 1)
        slopes[:, :, -1] = c[:, n:-1] @ policy.codes.T + c[:, -1:]
    turns = []
    ends = []
    for i, axis in enumerate(axes):
        low, high = axis["low"], axis["high"]
        low = (u[:, i] - 4 * v[:, i]).min() if low is None else low
        high = (u[:, i] + 4 * v[:, i]).max() if high is None else high
        ends.append((axis["name"], float(low), float(high)))
        period, middle = policy.periods[i], (low + high) / 2
        home = u[:, i] - period * np.round((u[:, i] - middle) / (period or 1))
        # The nearest image to any place of one turn is the rule itself or its twin.
        turns.append([home, home - np.copysign(period, home - middle)] if period else [u[:, i]])
    centres = [np.stack(columns, 1) for columns in product(*turns)]
    many = len(centres)
    return Sugeno(
        ends, names, np.vstack(centres), np.tile(v, (many, 1)), np.tile(slopes, (many, 1, 1))
    )


def to_fis(data: dict[str, Any], *_: Any) -> bytes:
    """The .fis file of a policy."""
    base = system(data)
    lines = ["[System]", "Name='policy'", "Type='sugeno'", "Version=2.0"]
    lines += [f"NumInputs={len(base.inputs)}", f"NumOutputs={len(base.outputs)}"]
    lines += [f"NumRules={len(base.centres)}", "AndMethod='prod'", "OrMethod='probor'"]
    lines += ["ImpMethod='prod'", "AggMethod='sum'", "DefuzzMethod='wtaver'"]
    numbers = []
    for i, (name, low, high) in enumerate(base.inputs):
        pairs = np.stack([base.widths[:, i], base.centres[:, i]], 1)
        sets, which = np.unique(pairs, axis=0, return_inverse=True)
        numbers.append(which.reshape(-1) + 1)
        lines += _variable(f"Input{i + 1}", name, low, high, "gaussmf", sets)
    for j, name in enumerate(base.outputs):
        sets, which = np.unique(base.slopes[:, j], axis=0, return_inverse=True)
        numbers.append(which.reshape(-1) + 1)
        low, high = sets[:, -1].min(), sets[:, -1].max()
        constant = not sets[:, :-1].any()
        shown = sets[:, -1:] if constant else sets
        high = high if high > low else low + 1
        kind = "constant" if constant else "linear"
        lines += _variable(f"Output{j + 1}", name, low, high, kind, shown)
    lines += ["", "[Rules]"]
    n = len(base.inputs)
    for row in np.stack(numbers, 1).tolist():
        given, said = (" ".join(map(str, part)) for part in (row[:n], row[n:]))
        lines.append(f"{given}, {said} (1) : 1")
    return "\n".join([*lines, ""]).encode()


def _variable(section: str, name: str, low: float, high: float, kind: str, sets: Any) -> list[str]:
    plain = re.sub(r"\W+", "_", name, flags=re.ASCII)
    head = ["", f"[{section}]", f"Name='{plain}'", f"Range=[{float(low)!r} {float(high)!r}]"]
    rows = (" ".join(map(repr, row)) for row in sets.tolist())
    terms = [f"MF{i}='m{i}':'{kind}',[{row}]" for i, row in enumerate(rows, 1)]
    return [*head, f"NumMFs={len(sets)}", *terms]


def read(path: Path) -> Sugeno:
    """The rules of a .fis file of any tool.

    Raises:
        ValueError: one line on what is wrong, or cannot be held by Gaussian rules.
    """
    try:
        with open(path, "rb") as file:
            text = file.read(MOST_BYTES).decode("utf-8", "replace")
        return _system(_sections(text))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    except KeyError as error:
        raise ValueError(
            f"{path}: not a .fis file, or not all of it ({error} is missing)"
        ) from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _sections(text: str) -> dict[str, Any]:
    """Entries by section, as in ``input1``, with names in small letters; of the rules the lines."""
    found: dict[str, Any] = {"rules": []}
    here: Any = {}
    for line in text.splitlines():
        line = line.strip()
        if head := SECTION.fullmatch(line):
            name = (head[1] + head[2]).lower()
            here = found["rules"] if name == "rules" else found.setdefault(name, {})
        elif not line or line[0] in "#%":
            continue
        elif isinstance(here, list):
            here.append(line)
        else:
            name, _, value = line.partition("=")
            here[name.strip().lower()] = value.strip()
    return found


def _system(found: dict[str, Any]) -> Sugeno:
    head = {name: value.strip("'\"").lower() for name, value in found["system"].items()}
    for name, wanted in WANTED.items():
        if head[name] != wanted:
            raise ValueError(f"{name} must be {wanted}, as the network computes, not {head[name]}")
    n, m = int(head["numinputs"]), int(head["numoutputs"])
    if not 0 < int(head["numrules"]) == len(found["rules"]) <= MOST_RULES:
        raise ValueError(f"NumRules is {head['numrules']}, but {len(found['rules'])} rules follow")
    inputs, sets = zip(*(_input(found[f"input{i + 1}"]) for i in range(n)), strict=True)
    names, terms = zip(*(_output(found[f"output{j + 1}"], n) for j in range(m)), strict=True)
    u, v, c = [], [], []
    for number, line in enumerate(found["rules"], 1):
        parts = re.fullmatch(r"([\d\s-]+),([\d\s-]+)\(\s*([\d.]+)\s*\)\s*:\s*([12])", line)
        given = [int(word) for word in parts[1].split()] if parts else []
        said = [int(word) for word in parts[2].split()] if parts else []
        if not parts or (len(given), len(said)) != (n, m) or min(given) < 0 or min(said) < 1:
            raise ValueError(f"rule {number}: {line[:40]!r} is none of Gaussian sets joined by and")
        if float(parts[3]) != 1 or (parts[4] != "1" and sum(map(bool, given)) > 1):
            raise ValueError(f"rule {number}: only weight 1 and the connection 1 (and) are known")
        try:
            places = [sets[i][k] for i, k in enumerate(given)]
            c.append([terms[j][k] for j, k in enumerate(said)])
        except KeyError as error:
            raise ValueError(f"rule {number}: there is no membership function {error}") from None
        u.append([centre for _, centre in places])
        v.append([width for width, _ in places])
    return Sugeno(list(inputs), list(names), np.array(u), np.array(v), np.array(c))


def _input(entries: dict[str, str]) -> tuple[tuple[str, float, float], dict[int, Any]]:
    low, high = _numbers(entries["range"].strip("[]"), 2, "Range")
    sets = {0: [ANYWHERE * (high - low), (low + high) / 2]}  # 0: a rule does not ask for it
    for number, kind, text in _memberships(entries):
        if kind != "gaussmf":
            raise ValueError(f"{kind} is no Gaussian: draw its rules again with gaussmf")
        sets[number] = _numbers(text, 2, kind)
        if sets[number][0] <= 0:
            raise ValueError("the width of a gaussmf must be positive")
    return (entries["name"].strip("'\""), low, high), sets


def _output(entries: dict[str, str], n: int) -> tuple[str, dict[int, Any]]:
    terms = {}
    for number, kind, text in _memberships(entries):
        if kind not in ("constant", "linear"):
            raise ValueError(f"an output must be constant or linear, not {kind}")
        found = _numbers(text, 1 if kind == "constant" else n + 1, kind)
        terms[number] = [0.0] * (n + 1 - len(found)) + found
    return entries["name"].strip("'\""), terms


def _memberships(entries: dict[str, str]) -> list[tuple[int, str, str]]:
    count = int(entries["nummfs"])
    found = []
    for number in range(1, count + 1):
        parts = MEMBERSHIP.fullmatch(entries[f"mf{number}"])
        if not parts:
            raise ValueError(f"MF{number} cannot be read: {entries[f'mf{number}'][:40]!r}")
        found.append((number, parts[2], parts[3]))
    return found


def _numbers(text: str, count: int, what: str) -> list[float]:
    values = [float(word) for word in text.replace(",", " ").split()]
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{what} needs {count} finite numbers, got [{text[:40]}]")
    return values


def _without_twins(table: NDArray[Any], turns: NDArray[Any]) -> list[int]:
    """Rules (K, c) but for those that are others a turn away; equal rules at one turn are two.

    Args:
        table: the rules within one turn, equal to five decimals where they are twins.
        turns: by how many turns each was away. Shape: (K, p).
    """
    found: set[tuple[Any, ...]] = set()
    times: Counter[tuple[Any, ...]] = Counter()
    kept = []
    rows = zip(np.round(table, 5).tolist(), turns.tolist(), strict=True)
    for number, (rule, away) in enumerate(rows):
        place = (*rule, *away)
        times[place] += 1
        if (this := (*rule, times[place])) not in found:
            found.add(this)
            kept.append(number)
    return kept


def as_policy(base: Sugeno, like: dict[str, Any]) -> dict[str, Any]:
    """A policy that decides as another one, by the rules of a system.

    Rules that are twins a turn apart become one. Consequents that the system lacks, such as
    deviations and the value, are the means of those of the other policy.

    Raises:
        ValueError: it has other inputs or outputs.
    """
    policy, decision = Policy(like), like["decision"]
    n, wanted = policy.centres.shape[1], len(system(like).outputs)
    if (base.centres.shape[1], len(base.outputs)) != (n, wanted):
        raise ValueError(f"{n} inputs and {wanted} outputs are needed, as in the policy of --like")
    consequents = np.tile(policy.consequents.mean(0), (len(base.centres), 1))
    if decision["kind"] == "normal":
        if base.slopes[:, :, :-1].any():
            raise ValueError("outputs must be constant for this learner, not linear")
        consequents[:, :wanted] = base.slopes[:, :, -1]
    elif policy.acting:
        consequents = base.slopes[:, 0]
    else:
        one = np.hstack([policy.codes, np.ones((wanted, 1))])
        weights = base.slopes[:, :, -1] @ np.linalg.pinv(one).T
        same = np.ptp(base.slopes[:, :, :-1], axis=1).max() < 1e-6
        if not same or np.abs(weights @ one.T - base.slopes[:, :, -1]).max() > 1e-6:
            raise ValueError("values that differ between actions so cannot be coded as in --like")
        consequents = np.hstack([base.slopes[:, 0, :-1], weights])
    kind, centres = np.dtype(like["precision"]), base.centres.copy()
    turning = np.flatnonzero(policy.periods)
    for i in turning:
        low = like["axes"][i]["low"] or 0.0
        # In the network's precision twins are equal again, but at the seam.
        centres[:, i] = low + np.mod(centres[:, i] - low, policy.periods[i])
    table = np.hstack([centres, base.widths, consequents]).astype(kind)
    turns = np.round((base.centres - centres)[:, turning] / policy.periods[turning])
    table = shortest(table[_without_twins(table.astype(float), turns)])
    parts = (table[:, :n].tolist(), table[:, n : 2 * n].tolist(), table[:, 2 * n :].tolist())
    names = ("centre", "width", "consequents")
    rules = [dict(zip(names, row, strict=True)) for row in zip(*parts, strict=True)]
    return Policy({**like, "rules": rules}).data
