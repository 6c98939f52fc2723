"""Rules as other fuzzy tools know them: Gaussian sets, `prod`, weighted averages (Sugeno systems).

The normalised sum of Gaussian rules is what these tools call Sugeno (or Takagi-Sugeno-Kang)
inference with a product and a weighted average. They know no input that wraps: each rule stands
there twice, a turn apart. `fis.py`, `fml.py` and `fcl.py` write and read their files.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable
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
WORDS = {"if", "is", "and", "or", "not", "then", "with", "rule", "term", "any", "very"}  # of rules


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

    @property
    def names(self) -> list[str]:
        """Names of the inputs and outputs in a file."""
        return identifiers([*(name for name, _, _ in self.inputs), *self.outputs])

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


def vocabulary(base: Sugeno) -> tuple[list[NDArray[Any]], list[NDArray[Any]], list[list[int]]]:
    """The different sets and conclusions of a system, as its file names them.

    Returns:
        widths and centres (c, 2) of the sets of each input, slopes and constant (c, n + 1) of the
        conclusions of each output, and numbers of both for each rule, from 1. Shape: (K, n + m).
    """
    pairs = np.stack([base.widths, base.centres], 2)
    sets = [np.unique(pairs[:, i], axis=0, return_inverse=True) for i in range(pairs.shape[1])]
    terms = [
        np.unique(base.slopes[:, j], axis=0, return_inverse=True) for j in range(len(base.outputs))
    ]
    rows = np.stack([which.reshape(-1) + 1 for _, which in (*sets, *terms)], 1)
    return [found for found, _ in sets], [found for found, _ in terms], rows.tolist()


def span(terms: NDArray[Any]) -> tuple[float, float]:
    """Lowest and highest constant of conclusions (c, n + 1), never the same."""
    low, high = float(terms[:, -1].min()), float(terms[:, -1].max())
    return low, high if high > low else low + 1


def identifiers(names: Iterable[str]) -> list[str]:
    """Names of ASCII letters, digits and underscores that differ, and are no words of rules."""
    found: list[str] = []
    for name in names:
        plain = re.sub(r"\W+", "_", name, flags=re.ASCII)
        plain = f"_{plain}" if not plain or plain[0].isdigit() or plain.lower() in WORDS else plain
        while plain in found:
            plain += "_"
        found.append(plain)
    return found


def assembled(
    inputs: list[tuple[str, float, float]],
    outputs: list[str],
    sets: list[dict[Any, list[float]]],
    terms: list[dict[Any, list[float]]],
    rules: list[tuple[list[Any], list[Any]]],
) -> Sugeno:
    """A system from the names of its parts.

    Args:
        inputs: as in `Sugeno`.
        outputs: as in `Sugeno`.
        sets: width and centre by name, of each input.
        terms: slopes and constant by name, of each output.
        rules: names of the sets, None where it does not ask for an input, and of the conclusions.

    Raises:
        ValueError: a rule names what is not there, or there are none or too many.
    """
    if not inputs or not outputs:
        raise ValueError("a system needs inputs and outputs")
    if not 0 < len(rules) <= MOST_RULES:
        raise ValueError(f"there must be 1 to {MOST_RULES:,} rules, not {len(rules)}")
    if any(width <= 0 for named in sets for width, _ in named.values()):
        raise ValueError("the width of a Gaussian set must be positive")
    free = [[ANYWHERE * (high - low), (low + high) / 2] for _, low, high in inputs]
    table, conclusions = [], []
    for number, (given, said) in enumerate(rules, 1):
        try:
            table.append([free[i] if k is None else sets[i][k] for i, k in enumerate(given)])
            conclusions.append([terms[j][k] for j, k in enumerate(said)])
        except KeyError as error:
            raise ValueError(f"rule {number}: there is no membership function {error}") from None
    places = np.array(table, float)
    return Sugeno(inputs, outputs, places[:, :, 1], places[:, :, 0], np.array(conclusions, float))


def numbers(words: list[str], count: int, what: str) -> list[float]:
    """So many finite numbers.

    Raises:
        ValueError: they are not.
    """
    values = [float(word) for word in words]
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{what} needs {count} finite numbers, got [{' '.join(words)[:40]}]")
    return values


def read_with(parse: Callable[[str], Sugeno], path: Path) -> Sugeno:
    """What a parser makes of a file.

    Raises:
        ValueError: one line on what is wrong with it, or cannot be held by Gaussian rules.
    """
    try:
        with open(path, "rb") as file:
            return parse(file.read(MOST_BYTES).decode("utf-8", "replace"))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    except KeyError as error:
        kind = path.suffix.lower()
        raise ValueError(
            f"{path}: not a {kind} file, or not all of it ({error} is missing)"
        ) from None
    except ValueError as error:
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from None


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
