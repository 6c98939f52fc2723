"""Numbers over seeds: their intervals, and verdicts that are corrected for how many there are."""

import functools
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from sofnn_torch.evaluate import CONFIDENCE, exact_interval

FEWEST = 5  # seeds: of fewer no interval keeps what it promises
HOLDS, FAILS, OPEN = "holds", "does not hold", "cannot tell"

Interval = Callable[[float], tuple[float, float]]  # of a level of confidence


def _none(level: float) -> tuple[float, float]:
    return math.nan, math.nan


@dataclass(frozen=True)
class Measured:
    """A number over seeds with its interval.

    Attributes:
        value: the number; NaN if there is none.
        at: its interval at a level of confidence; NaN if there are too few seeds for one.
        values: of the seeds, where they are too few.

    Examples:
        >>> measured = median(np.array([500.0, 510.0, 520.0, 540.0, 900.0]))
        >>> measured.value, measured.low, measured.high
        (520.0, 500.0, 900.0)
    """

    value: float
    at: Interval = _none
    values: tuple[float, ...] = ()

    @property
    def low(self) -> float:
        """Lower end of the 95 % interval."""
        return self.at(CONFIDENCE)[0]

    @property
    def high(self) -> float:
        """Upper end of the 95 % interval."""
        return self.at(CONFIDENCE)[1]


def bootstrap(
    samples: Sequence[NDArray[Any]], statistic: Callable[..., Any], seed: int = 0
) -> Measured:
    """A statistic of independent samples with its percentile interval (Efron 1979)."""
    if not all(map(len, samples)):
        return Measured(math.nan)
    value = float(statistic(*samples))
    if min(map(len, samples)) < FEWEST:
        return Measured(value, values=tuple(samples[0].tolist()) if len(samples) == 1 else ())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # equal values make a degenerate distribution
        drawn = stats.bootstrap(
            samples,
            statistic,
            paired=False,
            method="percentile",
            rng=np.random.default_rng(seed),
        ).bootstrap_distribution

    def at(level: float) -> tuple[float, float]:
        low, high = np.quantile(drawn, [0.5 - 0.5 * level, 0.5 + 0.5 * level])
        return float(low), float(high)

    return Measured(value, at)


def median(values: NDArray[Any]) -> Measured:
    """Median with its interval."""
    return bootstrap([values], np.median)


def mean(values: NDArray[Any]) -> Measured:
    """Mean with its interval."""
    return bootstrap([values], np.mean)


def ratio(above: NDArray[Any], below: NDArray[Any]) -> Measured:
    """Ratio of two medians with its interval."""

    def statistic(a: NDArray[Any], b: NDArray[Any], axis: int = -1) -> Any:
        return np.median(a, axis=axis) / np.median(b, axis=axis)

    return bootstrap([above, below], statistic)


def proportion(successes: float, count: float) -> Measured:
    """Share of successes with its exact interval."""
    if not count:
        return Measured(math.nan)
    return Measured(successes / count, functools.partial(exact_interval, successes, count))


def share(successes: NDArray[Any], trials: int) -> Measured:
    """Share of successes in equally many trials of each seed, with its exact interval.

    Trials of one seed are alike, and tell less than as many independent ones: the interval is that
    of the number of independent trials whose share would scatter as that of the seeds does (Korn
    and Graubard 1998).

    Args:
        successes: of each seed.
        trials: of each seed.
    """
    shares = successes / trials
    if len(shares) < FEWEST:
        return mean(shares)
    value, count, seeds = float(shares.mean()), trials * len(shares), len(shares)
    variance = float(shares.var(ddof=1)) / seeds
    if variance > 0.0:
        scale = (stats.t.ppf(0.975, count - 1) / stats.t.ppf(0.975, seeds - 1)) ** 2
        count = min(count, scale * value * (1.0 - value) / variance)
    return proportion(value * count, count)


def judge(measured: Measured, low: float, high: float, level: float = CONFIDENCE) -> str:
    """Whether the interval lies inside [low, high], outside, or neither."""
    least, most = measured.at(level)
    if low <= least and most <= high:
        return HOLDS
    if most < low or least > high:
        return FAILS
    return OPEN


def doubt(measured: Measured, low: float, high: float) -> float:
    """The least error level at which `judge` decides, between 1e-6 and 1: a p-value."""
    undecided, decided = -6.0, 0.0  # powers of ten
    if judge(measured, low, high, 0.0) == OPEN:
        return 1.0
    for _ in range(30):
        middle = 0.5 * (undecided + decided)
        if judge(measured, low, high, 1.0 - 10.0**middle) == OPEN:
            undecided = middle
        else:
            decided = middle
    return float(10.0**decided)


def verdicts(family: Sequence[tuple[Measured, float, float]]) -> list[str]:
    """Verdicts on claims of which all are right with 95 % confidence (Holm 1979).

    Args:
        family: what was measured, and the least and the greatest value with which a claim holds.
    """
    doubts = [doubt(*claim) for claim in family]
    found, order = [OPEN] * len(family), np.argsort(doubts, kind="stable")
    for rank, index in enumerate(order):
        if doubts[index] > (1.0 - CONFIDENCE) / (len(family) - rank):
            break
        found[index] = judge(*family[index])
    return found
