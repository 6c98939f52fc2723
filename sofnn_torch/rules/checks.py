"""What is doubtful in a rule base: rules that contradict, are overruled, idle or out of place.

Nothing here says that a policy is bad: a rule in a wall is harmless where no robot is, and rules
that contradict each other make a compromise. It says where to look.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sofnn_torch.learners.learner import Learner
from sofnn_torch.maze.plan import MazePlan
from sofnn_torch.rules import words
from sofnn_torch.rules.tables import FIRED

OVERLAP = 0.6  # greatest firing strength at which two rules meet: that of a distance of two widths
CHUNK = 256  # rules at a time, each beside all others
Array = NDArray[Any]


@dataclass(frozen=True)
class Finding:
    """One kind of doubt.

    Attributes:
        kind: what is found, in words.
        count: how often.
        examples: the worst of them, in words.
    """

    kind: str
    count: int
    examples: tuple[str, ...]


def findings(
    agent: Learner, states: Array, plan: MazePlan | None = None, most: int = 3
) -> list[Finding]:
    """All that is checked, each kind with its worst examples.

    Args:
        agent: the learner.
        states: of the decisions of a trial. Shape: (T, n).
        plan: the maze, of which walls are known; None for other tasks.
        most: examples of each kind.
    """
    usage = agent.usage(states)
    found = []
    if (votes := leanings(agent)) is not None:
        found.append(contradictions(agent, votes, most))
    if agent.choices:
        found.append(outvoted(agent, usage, most))
    found.append(unused(usage * len(states), most))
    if plan is not None:
        found.append(inside_walls(agent, plan, usage, most))
    return [*found, gaps(agent, states, most)]


def contradictions(agent: Learner, votes: Array, most: int) -> Finding:
    """Pairs of rules that overlap strongly and vote for actions more than half the range apart.

    Args:
        agent: the learner.
        votes: what each rule would do by itself, each number in [-1, 1]; NaN for what is
            undecided. Shape: (K, m).
        most: examples.
    """
    count, worst = 0, []
    for start in range(0, len(votes), CHUNK):
        some = np.arange(start, min(start + CHUNK, len(votes)))
        rest = np.arange(start, len(votes))
        apart = np.abs(votes[some][:, None] - votes[rest]).max(2) > 1  # no comparison with NaN
        meeting = overlap(agent, some, rest)
        i, j = np.nonzero(np.triu(apart & (meeting >= OVERLAP), 1))
        count += len(i)
        best = np.argsort(-meeting[i, j], kind="stable")[:most]
        worst += [
            (meeting[a, b], a + start, b + start) for a, b in zip(i[best], j[best], strict=True)
        ]
    said = [
        f"rule {a + 1} ({said_by(agent, votes[a])}) against rule {b + 1} "
        f"({said_by(agent, votes[b])}): both fire by {strength:.2f} between them"
        for strength, a, b in sorted(worst, key=lambda pair: -pair[0])[:most]
    ]
    return Finding("pairs of neighbours that vote against each other", count, tuple(said))


def leanings(agent: Learner) -> Array | None:
    """What each rule would do by itself, from -1 for the first action to 1 for the last.

    Shape: (K, m), m = 1 for choices. NaN for a rule that is undecided; None where each rule is
    about one action, or the learner does not say.
    """
    _, table = agent.conclusions(agent.net.centres)
    if agent.choices:
        alone = agent.alone(table)
        if alone is None or len(agent.choices) < 2:
            return None
        spread = 2.0 * alone / (len(agent.choices) - 1) - 1
        return np.where(alone < 0, np.nan, spread)[:, None]
    try:
        m = agent.decoding()["numbers"]
    except (ValueError, KeyError):
        return None
    return np.clip(table[:, :m], -1, 1)


def said_by(agent: Learner, vote: Array) -> str:
    """The vote (m,) of a rule in words."""
    if agent.choices:
        return agent.choices[round((vote[0] + 1) / 2 * (len(agent.choices) - 1))]
    pairs = zip(agent.task.actions, vote.tolist(), strict=True)
    return ", ".join(f"{name} {words.number(value)}" for name, value in pairs)


def overlap(agent: Learner, a: Array, b: Array) -> Array:
    """Greatest firing strength that both of two rules have at one state. Shape: (len(a), len(b)).

    Two Gaussians fire equally where the distance is divided in the ratio of the widths, and there
    by exp(-d^2 / 2) with d^2 the sum over inputs of ((u - u') / (v + v'))^2. This is the greatest
    where widths are in one ratio on all inputs, and a lower bound of it otherwise.
    """
    net, total = agent.net, np.zeros((len(a), len(b)))
    centres, widths = net.centres.double().numpy(), net.widths.double().numpy()
    for i, axis in enumerate(agent.inputs):
        away = centres[a, i][:, None] - centres[b, i]
        if axis.period:
            away -= axis.period * np.round(away / axis.period)
        total += (away / (widths[a, i][:, None] + widths[b, i])) ** 2
    return np.exp(-0.5 * total)


def outvoted(agent: Learner, usage: Array, most: int) -> Finding:
    """Rules at whose centres all rules together choose another action than they do."""
    reading = words.read(agent)
    wrong = np.flatnonzero(reading.outvoted)
    worst = wrong[np.argsort(-usage[wrong], kind="stable")[:most]]
    brief = reading.brief()
    together = agent.plan(agent.net.centres[worst, : len(agent.task.axes)].numpy()).choice
    assert together is not None  # there are choices
    said = [
        f"rule {k + 1} ({brief[k]}): there all say {agent.choices[j]}"
        for k, j in zip(worst, together, strict=True)
    ]
    return Finding("rules that are outvoted where they are centred", len(wrong), tuple(said))


def unused(firing: Array, most: int) -> Finding:
    """Rules that take no part in a trial; firing is what each adds up to in it. Shape: (K,)."""
    idle = np.flatnonzero(firing < FIRED)
    worst = idle[np.argsort(firing[idle], kind="stable")[:most]]
    said = (f"rules {_listed(worst)}",) if len(worst) else ()
    return Finding("rules that take no part on the way", len(idle), said)


def inside_walls(agent: Learner, plan: MazePlan, usage: Array, most: int) -> Finding:
    """Rules centred where no robot can stand."""
    places = agent.net.centres[:, :2].tolist()
    bad = np.array([k for k, place in enumerate(places) if not plan.has_room(*place)], int)
    worst = bad[np.argsort(-usage[bad], kind="stable")[:most]]
    said = [
        f"rule {k + 1} at {1000 * places[k][0]:.0f}, {1000 * places[k][1]:.0f} mm"
        for k in worst.tolist()
    ]
    return Finding("rules centred in a wall or too close to one", len(bad), tuple(said))


def gaps(agent: Learner, states: Array, most: int) -> Finding:
    """Decisions of a trial at which no rule fires by the growth threshold."""
    strongest = strengths(agent, states)
    low = np.flatnonzero(strongest < agent.net.theta)
    worst = low[np.argsort(strongest[low], kind="stable")[:most]]
    said = [
        f"decision {t + 1} at {', '.join(map(words.at, agent.task.axes, states[t].tolist()))}: "
        f"{strongest[t]:.2g}"
        for t in worst.tolist()
    ]
    kind = f"gaps: decisions where no rule fires by theta = {agent.net.theta:g}"
    return Finding(kind, len(low), tuple(said))


@torch.no_grad()
def strengths(agent: Learner, states: Array) -> Array:
    """Firing strength of the strongest rule at states (T, n). Shape: (T,)."""
    x = torch.from_numpy(np.asarray(states)).to(agent.net.default_width)
    inputs = agent.network_inputs(x).reshape(-1, len(agent.inputs))
    firing: Array = agent.net.firing_strengths(inputs).amax(1).double().numpy()
    return firing.reshape(len(states), -1).max(1)


def _listed(rules: Array) -> str:
    return ", ".join(str(k + 1) for k in rules.tolist())


def report(found: Sequence[Finding]) -> str:
    """Findings for the terminal: a line for each kind, its examples below."""
    lines = []
    for finding in found:
        lines.append(f"{finding.count:6,}  {finding.kind}")
        lines += [f"          {example}" for example in finding.examples]
    return "\n".join(lines)
