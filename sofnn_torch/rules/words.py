"""What the rules of a learner say, in words and numbers, and how they decide at one state.

Rules are numbered from 1 in what is printed and from 0 in arrays. Nothing is learned here and no
random number is drawn.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from sofnn_torch.learners.learner import Learner
from sofnn_torch.network.axes import Axis

MANY = 5  # actions that are shown side by side
WINDS = ("E", "NE", "N", "NW", "W", "SW", "S", "SE")  # east is along x, north along y
COMPASS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")


@dataclass(frozen=True)
class Reading:
    """All rules in words; every column has a cell for each of the K rules.

    Attributes:
        antecedents: by the name of the input with its unit, as in ``x, mm``.
        consequents: by the name of what is concluded; the chosen action has no name.
        outvoted: whether all rules together choose another action at the centre of a rule than the
            rule itself; False where actions are continuous or antecedents. Shape: (K,).
        together: the action that all rules choose at the centre of each; none where actions are
            continuous.
    """

    antecedents: dict[str, list[str]]
    consequents: dict[str, list[str]]
    outvoted: NDArray[np.bool_]
    together: list[str]

    def brief(self) -> list[str]:
        """The main conclusion of each rule in a few words, for a legend."""
        first = next(iter(self.consequents)).partition(" ")[0]
        main = {n: c for n, c in self.consequents.items() if n.partition(" ")[0] == first}
        if len(main) == 1 or first == "Q":
            name = next(iter(main))
            return [f"{name} {cell}".strip() for cell in main[name]]
        names = [name.removeprefix(f"{first} ") for name in main]
        return [
            ", ".join(f"{name} {cell}" for name, cell in zip(names, cells, strict=True))
            for cells in zip(*main.values(), strict=True)
        ]

    def sentences(self) -> list[str]:
        """Each rule as one line of text."""
        names = [name.partition(", ") for name in self.antecedents]
        first, *others = self.consequents
        lines = []
        for cells in zip(*self.antecedents.values(), *self.consequents.values(), strict=True):
            conditions = [
                f"{name} is about {cell} {unit}".rstrip()
                for (name, _, unit), cell in zip(names, cells, strict=False)
            ]
            conclusion, *more = cells[len(names) :]
            said = ", ".join(f"{name} {cell}" for name, cell in zip(others, more, strict=True))
            then = f"{first} {conclusion}".strip()
            lines.append(f"IF {' AND '.join(conditions)} THEN {then} ({said})")
        return lines


@dataclass(frozen=True)
class Decision:
    """How the rules decide at one state.

    Attributes:
        names: of the c outputs: mu, sigma, value (SGA) or the values of the actions (Q-learning).
        shares: normalised firing of each rule, by output: where the action is an antecedent, rules
            fire differently for each action. Shape: (K, c).
        conclusions: what each rule concludes by itself. Shape: (K, c).
        strongest: firing strength of the strongest rule; near 1 the state is well known.
        action: what the learner does without exploration.
    """

    names: list[str]
    shares: NDArray[np.float64]
    conclusions: NDArray[np.float64]
    strongest: float
    action: str

    @property
    def outputs(self) -> NDArray[np.float64]:
        """The weighted sums (eqs 4 and 10). Shape: (c,)."""
        return (self.shares * self.conclusions).sum(0)


@torch.no_grad()
def read(agent: Learner) -> Reading:
    """All rules of a learner in words."""
    net = agent.net
    columns = {
        column(axis): [about(axis, u, v) for u, v in zip(us, vs, strict=True)]
        for axis, us, vs in zip(
            agent.inputs, net.centres.T.tolist(), net.widths.T.tolist(), strict=True
        )
    }
    return Reading(columns, *_consequents(agent))


def _consequents(agent: Learner) -> tuple[dict[str, list[str]], NDArray[np.bool_], list[str]]:
    """The consequents of a `Reading`, which rules are outvoted, and by what."""
    centres = agent.net.centres
    names, table = agent.conclusions(centres)
    numbers = {name: list(map(number, table[:, i].tolist())) for i, name in enumerate(names)}
    nobody = np.zeros(len(centres), bool)
    if not agent.choices:
        return numbers, nobody, []
    together = agent.plan(centres[:, : len(agent.task.axes)].numpy()).choice
    assert together is not None  # there are choices
    there = [agent.choices[j] for j in together.tolist()]
    alone = agent.alone(table)
    if alone is None:  # each rule is about one action
        return numbers | {"best there": there}, nobody, there
    said = [*agent.choices, "undecided"]  # the last for -1
    if len(names) > MANY:
        numbers = {"Q": list(map(number, table.max(1).tolist()))}
    words = [said[j] for j in alone.tolist()]
    return {"": words} | numbers, (alone >= 0) & (alone != together), there


@torch.no_grad()
def decide(agent: Learner, state: NDArray[np.float32]) -> Decision:
    """How the rules decide at a state (n,) without exploration."""
    x = torch.from_numpy(state).to(agent.net.default_width)
    names, table = agent.conclusions(x)
    shares = agent.firing(state).double().numpy().T
    plan = agent.plan(state[None])
    if plan.choice is not None:
        said = agent.choices[plan.choice.item()]
    else:
        pairs = zip(agent.task.actions, plan.actions[0].tolist(), strict=True)
        said = ", ".join(f"{part} {number(value)}" for part, value in pairs)
    inputs = agent.network_inputs(x).reshape(-1, len(agent.inputs))
    strongest = agent.net.firing_strengths(inputs).max().item()
    return Decision(names, np.broadcast_to(shares, table.shape), table, strongest, said)


def column(axis: Axis) -> str:
    """Heading of the cells of an axis: its name, and the unit in which they are given."""
    if axis.unit == "rad" and axis.period:
        return axis.name  # a bearing bears its unit
    unit = "mm" if axis.unit == "m" else axis.unit
    return f"{axis.name}, {unit}" if unit else axis.name


def about(axis: Axis, centre: float, width: float) -> str:
    """A membership function in a cell: its centre and width, as ``150 ± 60``."""
    if axis.unit == "rad" and axis.period:
        return bearing(centre, width)
    if axis.unit == "m":
        return f"{1000 * centre:.0f} ± {1000 * width:.0f}"
    digits = decimals(axis)
    return f"{number(centre, digits)} ± {width:.{digits}f}"


def decimals(axis: Axis) -> int:
    """Decimals that tell a hundredth of the range of an axis, at least two."""
    return max(2, 2 - math.floor(math.log10(axis.high - axis.low))) if axis.bounded else 2


def at(axis: Axis, value: float) -> str:
    """A number on an axis with its name and unit, as in ``x 150 mm``."""
    if axis.unit == "rad" and axis.period:
        return f"{axis.name} {bearing(value)}"
    if axis.unit == "m":
        return f"{axis.name} {1000 * value:.0f} mm"
    return f"{axis.name} {number(value, decimals(axis))} {axis.unit}".rstrip()


def bearing(heading: float, width: float | None = None) -> str:
    """A heading in radians as degrees and a direction, with a width in radians if there is one."""
    degrees = round(math.degrees(math.remainder(heading, 2 * math.pi)))
    spread = "" if width is None else f" ± {math.degrees(width):.0f}"
    return f"{degrees}{spread}° {WINDS[octant(heading)]}"


def octant(heading: float) -> int:
    """The nearest of eight directions to a heading in radians, counted from east to the left."""
    return round(round(math.degrees(heading)) / 45) % 8


def number(value: float, digits: int = 2) -> str:
    """A few decimals, without a minus sign before zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}" if abs(value) < 1e5 else f"{value:.3g}"
