"""What a policy can do anywhere in a region: actions proved impossible there, or shown.

An output is a mean of consequents, weighted by firing strengths (eqs 4 and 10). In a box of states
each firing strength lies between two values that follow from the distances of the box to the rule's
centre. If every strength may take any value in between, the largest mean is exactly the one where
the rules with consequents above some switch point fire as strongly, and the others as weakly, as
they can; trying all switch points finds it (Karnik and Mendel, Centroid of a type-2 fuzzy set,
Information Sciences 132, 2001). In truth strengths do not vary independently, so this bound is
safe, not tight. Boxes that it does not decide are halved, and the states in their middles are
looked at for an example. Where the action is a vector, each of its numbers gets ends that it never
passes, by the same bound.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sofnn_torch.learners.learner import Learner
from sofnn_torch.network.axes import Axis

Array = NDArray[np.float64]

BATCH = 64  # boxes at a time
MOST = 100_000  # boxes until the search is given up
CLOSE = 0.01  # of the range of a number of the action: ends so close to an example are good enough
MARGIN = 1e-3  # of the span of the consequents: more than single precision errs


@dataclass(frozen=True)
class Answer:
    """Whether the policy takes an action anywhere in a region.

    Attributes:
        action: its name.
        possible: False where it is proved impossible, True where there is an example, None where
            the search was given up.
        example: a state (n,) of the region where it is taken.
    """

    action: str
    possible: bool | None
    example: Array | None = None


@dataclass(frozen=True)
class Range:
    """What a number of the action can be anywhere in a region.

    Attributes:
        name: of the number.
        low: it is proved to be nowhere below.
        least: the least at a state that was looked at.
        greatest: the greatest at one.
        high: it is proved to be nowhere above.
    """

    name: str
    low: float
    least: float
    greatest: float
    high: float


def strengths(
    low: Array, high: Array, centres: Array, widths: Array, axes: Sequence[Axis]
) -> tuple[Array, Array]:
    """Least and greatest firing strength (eq. 2) in boxes, over the greatest of any rule there.

    Args:
        low: lower ends of the boxes. Shape: (B, n).
        high: upper ends. Shape: (B, n).
        centres: Shape: (K, n).
        widths: Shape: (K, n).
        axes: of the n inputs.

    Returns:
        Two arrays. Shape: (B, K).
    """
    least, most = (np.zeros((len(low), len(centres))) for _ in range(2))
    for i, axis in enumerate(axes):
        middle, half = 0.5 * (low[:, i] + high[:, i]), 0.5 * (high[:, i] - low[:, i])
        distance = np.abs(middle[:, None] - centres[:, i])
        far = distance + half[:, None]
        if axis.period:
            distance = np.abs(distance - axis.period * np.round(distance / axis.period))
            far = np.minimum(distance + half[:, None], 0.5 * axis.period)
        near = np.maximum(distance - half[:, None], 0.0)
        least -= 0.5 * (far / widths[:, i]) ** 2
        most -= 0.5 * (near / widths[:, i]) ** 2
    top = most.max(1, keepdims=True)
    return np.exp(least - top), np.exp(most - top)


def greatest_mean(least: Array, most: Array, values: Array) -> Array:
    """Greatest weighted mean of values (K,) whose weights lie in given intervals. Shape: (B,).

    Args:
        least: lower ends of the weights. Shape: (B, K).
        most: upper ends, of which one at least is positive. Shape: (B, K).
        values: Shape: (K,).
    """
    order = np.argsort(-values)
    v, least, most = values[order], least[:, order], most[:, order]
    before = np.cumsum(most, 1)  # the rules up to here fire as strongly as they can
    after = least.sum(1, keepdims=True) - np.cumsum(least, 1)
    above = np.cumsum(most * v, 1)
    below = (least * v).sum(1, keepdims=True) - np.cumsum(least * v, 1)
    total = before + np.maximum(after, 0.0)
    means = np.divide(above + below, total, out=np.full_like(total, -np.inf), where=total > 0)
    return means.max(1)


def actions_within(
    agent: Learner, low: Sequence[float], high: Sequence[float], most: int = MOST
) -> list[Answer]:
    """For each action whether the policy, without exploration, takes it anywhere in a box.

    Args:
        agent: a learner with choices whose rules do not fire by action.
        low: lower end of each input of the state. Shape: (n,).
        high: upper end, for an input that wraps at most a period above. Shape: (n,).
        most: boxes to look at before an action is left undecided.

    Raises:
        ValueError: a box that is none, or a learner of which this cannot be told.
    """
    rivals = _rivals(agent)
    lows, highs = _box(agent.task.axes, low, high)
    axes, net = agent.task.axes, agent.net
    centres, widths = net.centres.double().numpy(), net.widths.double().numpy()
    examples: list[Array | None] = [None] * len(agent.choices)
    looked = 0
    while len(lows) and looked < most:
        (a, lows), (b, highs) = ((ends[-BATCH:], ends[:-BATCH]) for ends in (lows, highs))
        looked += len(a)
        _look(agent, 0.5 * (a + b), examples)
        bounds = strengths(a, b, centres, widths, axes)
        open_ = np.zeros(len(a), bool)
        for j, differences in enumerate(rivals):
            if examples[j] is None:
                open_ |= _may_win(*bounds, differences)
        a, b = _halves(a[open_], b[open_], widths)
        lows, highs = np.concatenate([lows, a]), np.concatenate([highs, b])
    undecided = _still_open(lows, highs, (centres, widths, axes), rivals)
    return [
        Answer(name, True if found is not None else None if undecided[j] else False, found)
        for j, (name, found) in enumerate(zip(agent.choices, examples, strict=True))
    ]


def ranges_within(
    agent: Learner, low: Sequence[float], high: Sequence[float], most: int = MOST
) -> list[Range]:
    """Between which ends each number of the action lies anywhere in a box, without exploration.

    Args:
        agent: a learner whose action is the mean of outputs of the network.
        low: lower end of each input of the state. Shape: (n,).
        high: upper end, for an input that wraps at most a period above. Shape: (n,).
        most: boxes to look at for each end before the bound found so far is taken.

    Raises:
        ValueError: a box that is none, or a learner of which this cannot be told.
    """
    if agent.choices or agent.decoding().get("kind") != "normal":
        raise ValueError("ranges are for actions that are vectors of means")
    box, found = _box(agent.task.axes, low, high), []
    for i, name in enumerate(agent.task.actions):
        least, below = _greatest(agent, box, i, -1.0, most)
        greatest, above = _greatest(agent, box, i, 1.0, most)
        found.append(Range(name, max(-below, -1.0), -least, greatest, min(above, 1.0)))
    return found


def _greatest(
    agent: Learner, box: tuple[Array, Array], number: int, sign: float, most: int
) -> tuple[float, float]:
    """The greatest that a number of the action, times a sign, was in a box, and a bound of all.

    Of all boxes those with the greatest bounds are looked at and halved first.
    """
    net, axes, (lows, highs) = agent.net, agent.task.axes, box
    centres, widths = net.centres.double().numpy(), net.widths.double().numpy()
    values = sign * net.consequents[:, number].double().numpy()
    margin, seen, looked = MARGIN * float(np.ptp(values)), -math.inf, 0
    bounds = greatest_mean(*strengths(lows, highs, centres, widths, axes), values)
    while looked < most:
        middles = (0.5 * (lows + highs))[np.argsort(-bounds)[:BATCH]].astype(np.float32)
        seen = max(seen, float((sign * agent.plan(middles).actions[:, number]).max()))
        open_ = bounds > seen + 2 * CLOSE
        if not open_.any():
            break
        lows, highs, bounds = lows[open_], highs[open_], bounds[open_]
        order = np.argsort(-bounds)
        first, rest = order[:BATCH], order[BATCH:]
        looked += len(first)
        a, b = _halves(lows[first], highs[first], widths)
        fresh = greatest_mean(*strengths(a, b, centres, widths, axes), values)
        lows, highs = np.concatenate([lows[rest], a]), np.concatenate([highs[rest], b])
        bounds = np.concatenate([bounds[rest], fresh])
    return seen, float(max(bounds.max(initial=-math.inf), seen)) + margin


def _halves(lows: Array, highs: Array, widths: Array) -> tuple[Array, Array]:
    """Boxes (B, n), halved across the side that is longest beside the rules. Shape: (2B, n)."""
    side = ((highs - lows) / np.median(widths, 0)).argmax(1)
    rows, middle = np.arange(len(lows)), 0.5 * (lows + highs)
    left, right = highs.copy(), lows.copy()
    left[rows, side] = right[rows, side] = middle[rows, side]
    return np.concatenate([lows, right]), np.concatenate([left, highs])


def _box(axes: Sequence[Axis], low: Sequence[float], high: Sequence[float]) -> tuple[Array, Array]:
    """A region as a box each of lower and of upper ends. Shape: (1, n).

    Raises:
        ValueError: it is none.
    """
    lows, highs = np.array([low], float), np.array([high], float)
    if lows.shape != (1, len(axes)) or highs.shape != lows.shape:
        raise ValueError(f"a region needs two ends for each of {len(axes)} inputs")
    if not (np.isfinite(lows).all() and np.isfinite(highs).all() and (lows <= highs).all()):
        raise ValueError("the ends of a region are finite, the lower one first")
    for axis, a, b in zip(axes, lows[0], highs[0], strict=True):
        if axis.period and b - a > axis.period * (1 + 1e-6):
            raise ValueError(f"a region spans at most a whole turn of {axis.name}")
    return lows, highs


def _look(agent: Learner, states: Array, examples: list[Array | None]) -> None:
    """Keep the first state at which each action is taken, as the policy sees it."""
    seen = states.astype(np.float32)
    choice = agent.plan(seen).choice
    assert choice is not None
    for j in np.unique(choice):
        if examples[j] is None:
            examples[j] = seen[np.argmax(choice == j)].astype(float)


def _still_open(
    lows: Array, highs: Array, rules: tuple[Any, ...], rivals: Sequence[Sequence[Array]]
) -> list[bool]:
    """Whether each action may be taken in a box that is left."""
    result = np.zeros(len(rivals), bool)
    for start in range(0, len(lows), BATCH):
        part = slice(start, start + BATCH)
        bounds = strengths(lows[part], highs[part], *rules)
        result |= [bool(_may_win(*bounds, differences).any()) for differences in rivals]
    return result.tolist()


def _may_win(least: Array, most: Array, differences: Sequence[Array]) -> NDArray[np.bool_]:
    """Whether an action may be ahead of all others, by its lead in each rule. Shape: (B,)."""
    result = np.ones(len(least), bool)
    for lead in differences:
        margin = MARGIN * (lead.max() - lead.min()) + 1e-9
        result &= greatest_mean(least, most, lead) >= -margin
    return result


def _rivals(agent: Learner) -> list[list[Array]]:
    """For each action how far each rule puts it ahead of each rival: it is taken where all >= 0.

    Raises:
        ValueError: the actions are vectors, or an input of the rules.
    """
    decoding, consequents = agent.decoding(), agent.net.consequents.double().numpy()
    if not agent.choices or decoding.get("action_input"):
        raise ValueError("regions are for discrete actions that are no input of the rules")
    if decoding["kind"] == "normal":  # a mean between two edges
        mean, edges = consequents[:, 0], [-math.inf, *decoding["edges"], math.inf]
        ends = itertools.pairwise(edges)
        return [[lead for lead in (mean - a, b - mean) if np.isfinite(lead).all()] for a, b in ends]
    codes = np.array(decoding["codes"])
    n = len(agent.task.axes)
    shares = consequents[:, n : n + codes.shape[1]] @ codes.T  # what is not shared by the actions
    count = range(len(codes))
    return [[shares[:, j] - shares[:, i] for i in count if i != j] for j in count]
