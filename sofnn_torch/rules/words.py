"""What the rules of a learner say, in words and numbers, and how they decide at one state.

Rules are numbered from 1 in what is printed and from 0 in arrays. Nothing is learned here and no
random number is drawn.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from sofnn_torch.learners.sga import SGA
from sofnn_torch.learners.survey import survey
from sofnn_torch.runs.factory import Agent

MANY = 5  # actions that are shown side by side
TURNS = ("right turn", "straight", "left turn")
WINDS = ("E", "NE", "N", "NW", "W", "SW", "S", "SE")  # east is along x, north along y


@dataclass(frozen=True)
class Reading:
    """All rules in words; every column has a cell for each of the K rules.

    Attributes:
        antecedents: by the name of the input with its unit, as in ``x, mm``.
        consequents: by the name of what is concluded; the chosen action has no name.
        outvoted: whether all rules together choose another action at the centre of a rule than the
            rule itself; False where actions are continuous or antecedents. Shape: (K,).
    """

    antecedents: dict[str, list[str]]
    consequents: dict[str, list[str]]
    outvoted: NDArray[np.bool_]

    def brief(self) -> list[str]:
        """The main conclusion of each rule in a few words, for a legend."""
        (name, cells), *more = self.consequents.items()
        if more and more[0][0] == "mu right":
            pairs = zip(cells, more[0][1], strict=True)
            return [f"wheels {left}, {right}" for left, right in pairs]
        return [f"{name} {cell}".strip() for cell in cells]

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
def read(agent: Agent) -> Reading:
    """All rules of a learner in words."""
    net = agent.net
    x, y, heading, *action = (
        list(zip(u, v, strict=True))
        for u, v in zip(net.centres.T.tolist(), net.widths.T.tolist(), strict=True)
    )
    columns = {
        "x, mm": [f"{1000 * u:.0f} ± {1000 * v:.0f}" for u, v in x],
        "y, mm": [f"{1000 * u:.0f} ± {1000 * v:.0f}" for u, v in y],
        "heading": [bearing(u, v) for u, v in heading],
    }
    for pairs in action:
        columns["action"] = [f"{number(u)} ± {v:.2f}" for u, v in pairs]
    return Reading(columns, *_consequents(agent))


def _consequents(agent: Agent) -> tuple[dict[str, list[str]], NDArray[np.bool_]]:
    """The consequents of a `Reading`, and which rules are outvoted."""
    states = agent.net.centres[:, :3]
    names, table = conclusions(agent, states)
    numbers = {name: list(map(number, table[:, i].tolist())) for i, name in enumerate(names)}
    nobody = np.zeros(len(states), bool)
    if not (actions := _actions(agent)):
        return numbers, nobody
    turns, scale = survey(agent, states.numpy()).turn, _scale(agent)
    together = np.abs(turns[:, None] - scale).argmin(1)
    if agent.net.n_inputs > 3:  # each rule is about one action
        features = torch.cat([agent.net.centres, states.new_ones(len(states), 1)], 1)
        values = (agent.net.consequents * features).sum(1).tolist()
        words = [actions[j] for j in together.tolist()]
        return {"Q": list(map(number, values)), "best there": words}, nobody
    if isinstance(agent, SGA):
        alone = 1 + (table[:, 0] > 1 / 3).astype(int) - (table[:, 0] < -1 / 3)
    else:
        alone = table.argmax(1)
        alone[(table == table.max(1, keepdims=True)).sum(1) > 1] = -1
    outvoted = (alone >= 0) & (alone != together)
    said = [*actions, "undecided"]  # the last for -1
    words = [said[j] for j in alone.tolist()]
    if len(names) > MANY:
        numbers = {"Q": list(map(number, table.max(1).tolist()))}
    return {"": words} | numbers, outvoted


def conclusions(agent: Agent, x: torch.Tensor) -> tuple[list[str], NDArray[np.float64]]:
    """What each rule concludes by itself: names (c,) and numbers (K, c).

    For SGA these are the consequents, for Q-learning the values f_k(x, a_j) of all actions (eq. 9).

    Args:
        agent: the learner.
        x: the state, one for all rules or one each. Shape: (3,) or (K, 3).
    """
    consequents = agent.net.consequents.double()
    if isinstance(agent, SGA):
        sides = (" left", " right") if agent.m == 2 else ("",)
        names = [f"{part}{side}" for part in ("mu", "sigma") for side in sides]
        return [*names, *["value"] * agent.learned], consequents.numpy()
    n = agent.n
    of_state = (consequents[:, :n] * x).sum(1, keepdim=True)
    values = of_state + consequents[:, n:] @ agent.tails.double().T
    return [f"Q {name}" for name in _actions(agent)], values.numpy()


@torch.no_grad()
def decide(agent: Agent, state: NDArray[np.float32]) -> Decision:
    """How the rules decide at a state (3,) without exploration."""
    x = torch.from_numpy(state).to(agent.net.default_width)
    names, table = conclusions(agent, x)
    inputs = x[None]
    if agent.net.n_inputs > 3:
        inputs = torch.cat([x.expand(len(agent.codes), -1), agent.codes], 1)
    shares = agent.net.normalised_firing(inputs).double().numpy().T
    action = agent.act(state)
    if isinstance(action, int):
        said = TURNS[action]
    else:
        parts = ("left wheel", "right wheel") if len(action) == 2 else ("steer",)
        pairs = zip(parts, action.tolist(), strict=True)
        said = ", ".join(f"{part} {number(value)}" for part, value in pairs)
    strongest = agent.net.firing_strengths(inputs).max().item()
    return Decision(names, np.broadcast_to(shares, table.shape), table, strongest, said)


def _actions(agent: Agent) -> list[str]:
    """Names of the actions that a learner chooses among; none if they are continuous."""
    if agent.config.actions == "three":
        return list(TURNS)
    return [] if isinstance(agent, SGA) else [f"{a:+.2f}" for a in agent.representatives]


def _scale(agent: Agent) -> list[float]:
    """The same actions as turns from -1 to 1."""
    return [-1.0, 0.0, 1.0] if agent.config.actions == "three" else agent.representatives


def bearing(heading: float, width: float | None = None) -> str:
    """A heading in radians as degrees and a direction, with a width in radians if there is one."""
    degrees = round(math.degrees(math.remainder(heading, 2 * math.pi)))
    spread = "" if width is None else f" ± {math.degrees(width):.0f}"
    return f"{degrees}{spread}° {WINDS[round(degrees / 45) % 8]}"


def number(value: float) -> str:
    """Two decimals, without a minus sign before zero."""
    return f"{round(value, 2) + 0.0:.2f}" if abs(value) < 1e5 else f"{value:.3g}"
