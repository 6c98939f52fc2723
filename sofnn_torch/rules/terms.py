"""Rules as sentences: each axis in a few linguistic terms instead of numbers.

A range is cut into equal parts, each a term. A rule is about the term in which its centre lies, and
about every other one in whose middle its membership is a half or more; an axis on which that is all
of them is left out. Where the axes of a maze or of a known task have directions, the terms do too.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from sofnn_torch.learners.learner import Learner
from sofnn_torch.network.axes import Axis
from sofnn_torch.rules import words
from sofnn_torch.rules.words import COMPASS, Reading

HALF = math.sqrt(2 * math.log(2))  # widths from the centre where a membership is a half

# Terms of an axis by its name and unit: lower side, middle, upper side, what makes a side stronger.
SIDES = {
    ("x", "m"): ("west", "middle", "east", "far"),
    ("y", "m"): ("south", "middle", "north", "far"),
    ("goal x", "m"): ("west", "middle", "east", "far"),
    ("goal y", "m"): ("south", "middle", "north", "far"),
    ("position", ""): ("left", "middle", "right", "far"),
    ("velocity", ""): ("leftward", "near zero", "rightward", "fast"),
    ("cart position", ""): ("left", "middle", "right", "far"),
    ("cart velocity", ""): ("leftward", "near zero", "rightward", "fast"),
    ("pole angle", "rad"): ("left", "upright", "right", "far"),
    ("pole velocity", "rad/s"): ("leftward", "near zero", "rightward", "fast"),
    ("steer", ""): ("right", "straight", "left", "far"),
}
SIGNED = ("negative", "near zero", "positive", "very")
PLAIN = ("low", "medium", "high", "very")
DO = {"right turn": "turn right", "left turn": "turn left", "straight": "go straight"}


@dataclass(frozen=True)
class Terms:
    """The terms of one axis.

    Args:
        axis: which.
        names: from the lower end on; of an axis that wraps from 0 on, to the left.
        low: where the first begins; of an axis that wraps half a term below 0.
        high: where the last ends.

    Examples:
        >>> x = terms(Axis("x", "m", 0, 1), 5)
        >>> x.names
        ['far west', 'west', 'middle', 'east', 'far east']
        >>> x.of(0.35, 0.06), x.of(0.35, 0.15), x.of(0.35, 9)
        ('west', 'west to middle', '')
    """

    axis: Axis
    names: list[str]
    low: float
    high: float

    @property
    def step(self) -> float:
        """Length of a term."""
        return (self.high - self.low) / len(self.names)

    def of(self, centre: float, width: float) -> str:
        """What a membership function is about: a term, ``A to B``, or nothing if it is all."""
        middles = self.low + self.step * (np.arange(len(self.names)) + 0.5)
        away = middles - centre
        if period := self.axis.period:
            away -= period * np.round(away / period)
        about = np.abs(away) <= HALF * width
        if about.all():
            return ""
        about[np.abs(away).argmin()] = True
        found = [self.names[i] for i in np.argsort(away) if about[i]]
        return found[0] if len(found) == 1 else f"{found[0]} to {found[-1]}"

    def bounds(self) -> str:
        """The terms with the numbers between them, in one line."""
        if self.axis.period:
            return f"{self.axis.name}: {len(self.names)} equal parts, {self.names[0]} is around 0"
        scale, unit = (1000, "mm") if self.axis.unit == "m" else (1, self.axis.unit)
        digits = 0 if scale > 1 else words.decimals(self.axis)
        text = f"{self.axis.name} in {unit}: " if unit else f"{self.axis.name}: "
        for i, name in enumerate(self.names[:-1], start=1):
            text += f"{name} < {words.number(scale * (self.low + i * self.step), digits)} < "
        return text + self.names[-1]


def terms(axis: Axis, count: int, seen: tuple[float, float] = (-1.0, 1.0)) -> Terms:
    """The terms of an axis; of one that wraps always eight.

    Args:
        axis: which.
        count: how many, from 2 to 7; an even number has no middle.
        seen: ends of what is cut where the axis has no ends.
    """
    if axis.period:
        step = axis.period / 8
        names = [words.number(i * step) for i in range(8)]
        if axis.unit == "rad":
            names = [*COMPASS] if axis.name == "heading" else [f"{45 * i}°" for i in range(8)]
        return Terms(axis, names, -step / 2, axis.period - step / 2)
    low, high = (axis.low, axis.high) if axis.bounded else seen
    plain = SIGNED if low == -high else PLAIN
    below, middle, above, more = SIDES.get((axis.name, axis.unit), plain)
    degrees = [("",), (f"{more} ", ""), (f"{more} ", "", "slightly ")][count // 2 - 1]
    names = [f"{degree}{below}" for degree in degrees] + [middle] * (count % 2)
    names += [f"{degree}{above}" for degree in reversed(degrees)]
    return Terms(axis, names, low, high)


def of_rules(agent: Learner, count: int) -> list[Terms]:
    """The terms of each axis of the state; without ends, of the range of the rules' centres."""
    centres, widths = agent.net.centres, agent.net.widths
    low, high = (centres - widths).amin(0).tolist(), (centres + widths).amax(0).tolist()
    axes = agent.task.axes
    return [terms(axis, count, (low[i], high[i])) for i, axis in enumerate(axes)]


def sentences(agent: Learner, reading: Reading, count: int = 5) -> list[str]:
    """Each rule as a sentence: where it is, and what it does there.

    Args:
        agent: the learner.
        reading: its rules, as `words.read` gives them.
        count: terms on an axis.
    """
    found, net = of_rules(agent, count), agent.net
    rows = zip(
        net.centres.tolist(), net.widths.tolist(), _deeds(agent, reading, count), strict=True
    )
    lines = []
    for centre, width, deed in rows:
        said = [axis.of(u, v) for axis, u, v in zip(found, centre, width, strict=False)]
        place = where([axis.axis for axis in found], said)
        lines.append(f"{place[0].upper()}{place[1:]}: {deed}.")
    return lines


def where(axes: list[Axis], said: list[str]) -> str:
    """A place in words, from what is said of each axis: nothing where it is at any value."""
    by_axis = {(axis.name, axis.unit): term for axis, term in zip(axes, said, strict=True)}
    parts = []
    if {("x", "m"), ("y", "m")} <= by_axis.keys():
        parts.append(_region(by_axis.pop(("x", "m")), by_axis.pop(("y", "m"))))
    parts += [f"{name} {term}" for (name, _), term in by_axis.items() if term]
    return ", ".join(filter(None, parts)) or "anywhere"


def _region(x: str, y: str) -> str:
    """Terms from west to east and from south to north as one phrase."""
    if not (x and y) or " to " in x + y:
        sides = (_side(y, "row"), _side(x, "column"))
        return ", ".join(filter(None, sides))
    if "middle" in (x, y):
        other = x if y == "middle" else y
        return "in the middle" if other == "middle" else f"in the middle of the {other}"
    (degree, _), (same, east) = y.rpartition(" ")[::2], x.rpartition(" ")[::2]
    return f"in the {y}-{east}" if degree == same else f"in the {y} and {x}"


def _side(term: str, line: str) -> str:
    """A term of one axis of a maze as a phrase, where the other axis is not one term."""
    if " to " in term:
        return f"from {term}"
    if term == "middle":
        return f"in the middle {line}"
    return term and f"in the {term}"


def _deeds(agent: Learner, reading: Reading, count: int) -> list[str]:
    """What each rule does by itself, and what all do there if it is outvoted."""
    _, table = agent.conclusions(agent.net.centres)
    if not agent.choices:
        return _numbers(agent, table, count)
    if len(agent.inputs) > len(agent.task.axes):  # each rule is about one action
        state = torch.zeros(len(agent.task.axes))
        codes = agent.network_inputs(state)[:, -1]
        nearest = (agent.net.centres[:, -1:] - codes).abs().argmin(1).tolist()
        worth = map(words.number, table[:, 0].tolist())
        return [
            f"{agent.choices[j]} is worth {value}" for j, value in zip(nearest, worth, strict=True)
        ]
    lines = []
    for k, deed in enumerate(reading.consequents[""]):
        said = DO.get(deed, deed)
        if reading.outvoted[k]:
            there = reading.together[k]
            said += f" (outvoted: all rules together {DO.get(there, f'choose {there}')} there)"
        lines.append(said)
    return lines


def _numbers(agent: Learner, table: NDArray[np.float64], count: int) -> list[str]:
    """The numbers of an action in terms of their range, -1 to 1."""
    ranges = [terms(Axis(name, "", -1.0, 1.0), count) for name in agent.task.actions]
    return [
        ", ".join(
            f"{part.axis.name} {part.of(value, 0)} ({words.number(value)})"
            for part, value in zip(ranges, row, strict=False)
        )
        for row in table.tolist()
    ]
