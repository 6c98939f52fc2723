"""Why a policy did what it did: the rules for it and against it, in a sentence and a table."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.table import Table

from sofnn_torch.learners.learner import Learner
from sofnn_torch.maze.plan import MazePlan
from sofnn_torch.rules import words

Array = NDArray[Any]

NEAR = 0.1  # m between robot and wall within which the wall is named
ENOUGH = 0.9  # share of the firing whose rules are listed
MOST = 12  # rules in the table
NAMED = 0.05  # share from which a rule is named in the sentence
DONE = {"right turn": "turned right", "left turn": "turned left", "straight": "went straight"}


@dataclass(frozen=True)
class Reason:
    """How far each rule speaks for what was done at a state.

    Attributes:
        state: where. Shape: (n,).
        action: what the policy does there without exploration.
        votes: what each rule would do by itself, in words. K of them.
        values: what each rule says of the action, see `reason`. Shape: (K,).
        shares: normalised firing of each rule. Shape: (K,).
        strongest: firing strength of the strongest rule.
        theta: the growth threshold.
    """

    state: Array
    action: str
    votes: list[str]
    values: Array
    shares: Array
    strongest: float
    theta: float

    @property
    def weights(self) -> Array:
        """Share times value: above 0 for the action, below against it. Shape: (K,)."""
        return self.shares * self.values

    def deciding(self, least: float = NAMED) -> tuple[list[int], list[int]]:
        """The rules for and against the action with at least a share, those of weight first."""
        order = np.argsort(-np.abs(self.weights), kind="stable").tolist()
        named = [k for k in order if self.shares[k] >= least] or order[:1]
        for_it = [k for k in named if self.values[k] > 0]
        return for_it, [k for k in named if self.values[k] <= 0]


def reason(agent: Learner, state: NDArray[np.float32]) -> Reason:
    """How far each rule speaks for the action at a state (n,).

    A rule's value is its margin: for choices by action values that of the chosen action over the
    best other one; for choices by a mean how far the rule's mean is inside the part of the range
    that stands for the action; for numbers the rule's own number towards the side of the action, of
    the number that is furthest from 0.

    Raises:
        ValueError: rules have no vote of their own: each is about one action.
    """
    if len(agent.inputs) > len(agent.task.axes):
        raise ValueError("--why needs rules that vote, not --q.coding antecedent: use --at")
    decision, plan = words.decide(agent, state), agent.plan(state[None])
    table = decision.conclusions
    if agent.choices:
        alone = agent.alone(table)
        if alone is None or plan.choice is None:
            raise ValueError(f"--why does not know how --agent {agent.name} votes: use --at")
        values = agent.margins(table, int(plan.choice[0]))
        said = [*agent.choices, "undecided"]  # the last for -1
        votes = [said[j] for j in alone.tolist()]
    else:
        action = np.asarray(plan.actions[0], float)
        j = int(np.abs(action).argmax())
        values = np.sign(action[j]) * table[:, j]
        name = agent.task.actions[j]
        votes = [f"{name} {words.number(value)}" for value in table[:, j].tolist()]
    return Reason(
        state,
        decision.action,
        votes,
        values,
        decision.shares[:, 0],
        decision.strongest,
        agent.net.theta,
    )


def sentence(agent: Learner, why: Reason, plan: MazePlan | None = None) -> str:
    """What was done and why, as one sentence."""
    for_it, against = why.deciding()
    done = DONE.get(why.action, f"chose {why.action}" if agent.choices else f"did {why.action}")
    if for_it:
        text = f"{done} because {_rules(for_it[:3])}, {_where(agent, why, plan)}, say so"
        text = text if len(for_it[:3]) > 1 else text.removesuffix("say so") + "says so"
    else:
        text = f"{done}, {_where(agent, why, plan)}, as a compromise of rules that each say else"
    if against:
        verbs = dict.fromkeys(why.votes[k] for k in against[:2])
        text += f" against {_rules(against[:2])} ({', '.join(verbs)})"
    return f"{text}."


def _rules(numbers: list[int]) -> str:
    said = [str(k + 1) for k in numbers]
    if len(said) == 1:
        return f"rule {said[0]}"
    return f"rules {', '.join(said[:-1])} and {said[-1]}"


def _where(agent: Learner, why: Reason, plan: MazePlan | None) -> str:
    """The place in words: in the maze the nearest wall and the heading."""
    state = why.state.tolist()
    if plan is None:
        return "at " + ", ".join(map(words.at, agent.task.axes, state))
    x, y, heading = state[:3]
    facing = f"heading {compass(heading)}"
    away, bearing = nearest_wall(plan, x, y)
    return f"near the {compass(bearing)} wall and {facing}" if away < NEAR else facing


def nearest_wall(plan: MazePlan, x: float, y: float) -> tuple[float, float]:
    """Distance [m] from the robot's rim to the nearest wall, and its bearing [rad]."""
    found = []
    for x0, y0, x1, y1 in plan.walls:
        dx, dy = min(max(x, x0), x1) - x, min(max(y, y0), y1) - y
        found.append((math.hypot(dx, dy), math.atan2(dy, dx)))
    distance, bearing = min(found)
    return distance - plan.robot_radius, bearing


def compass(bearing: float) -> str:
    """A bearing [rad] in words; east is along x."""
    return words.COMPASS[words.octant(bearing)]


def table(agent: Learner, why: Reason) -> Table:
    """The rules that make up most of the firing: share, vote, and share times value."""
    view = Table(
        "rule",
        "share",
        "votes for",
        "value",
        "product",
        "IF",
        box=SIMPLE_HEAD,
        pad_edge=False,
    )
    for column in (0, 1, 3, 4):
        view.columns[column].justify = "right"
    reading = words.read(agent)
    order = np.argsort(-why.shares, kind="stable")
    count = min(MOST, 1 + int((why.shares[order].cumsum() < ENOUGH).sum()))
    names = [name.partition(", ") for name in reading.antecedents]
    for k in order[:count].tolist():
        cells = (column[k] for column in reading.antecedents.values())
        pairs = zip(names, cells, strict=True)
        place = ", ".join(f"{name} {cell} {unit}".rstrip() for (name, _, unit), cell in pairs)
        view.add_row(
            str(k + 1),
            f"{why.shares[k]:.1%}",
            why.votes[k],
            f"{why.values[k]:+.2f}",
            f"{why.weights[k]:+.3f}",
            place,
        )
    rest = order[count:]
    if len(rest):
        sums = f"{why.shares[rest].sum():.1%}", f"{why.weights[rest].sum():+.3f}"
        view.add_row("rest", sums[0], "", "", sums[1], f"{len(rest):,} other rules")
    view.add_section()
    view.add_row("all", "100%", why.action, "", f"{why.weights.sum():+.3f}", "")
    return view


def threshold(why: Reason) -> str:
    """How well the place is known."""
    known = (
        "a known place" if why.strongest >= why.theta else "hardly known, a rule is missing here"
    )
    return f"strongest firing {why.strongest:.2g}, growth threshold theta {why.theta:g}: {known}"
