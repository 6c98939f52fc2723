"""Tile coding: what fuzzy rules compete with, on the same states and with the same traces.

Overlapping grids, each moved by a part of a tile, say in which tiles a state lies; their values are
summed (Sutton and Barto, Reinforcement Learning, 2nd edition, 9.5.4, 12.7):

    Q(x, a) = sum of w(i, a) over the tiles i of x
    dQ      = r + gamma Q(x', a') - Q(x, a)           (Watkins: gamma max over a')
    w <- w + alpha / m dQ E,   E <- gamma lambda E, then 1 at the m tiles of (x, a)
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sofnn_torch.network.axes import Axis

MOVED = (1, 3, 5, 7, 9, 11)  # parts of a tile by which the next grid is moved along each axis


@dataclass(frozen=True)
class TileConfig:
    """Settings of a tile coder that learns; those that a search found for the maze (peers).

    Examples:
        >>> TileConfig(tiles=(4, 4, 6)).tilings
        8
    """

    tilings: int = 8
    """Number of grids m."""
    tiles: tuple[int, ...] = (6, 6, 8)
    """Tiles of a grid along each axis."""
    rate: float = 0.8
    """Step size alpha."""
    trace_decay: float = 0.95
    """Lambda of the replacing eligibility traces."""
    initial: float = 0.65
    """Value of an unknown state; optimistic at the start of the maze."""
    epsilon: float = 0.01
    """Share of decisions that are drawn by chance."""
    watkins: bool = False
    """Learn the values of the best next action, and clear the traces at another."""
    gamma: float = 0.99
    """Discount per decision."""


class TileCoder:
    """Sarsa(lambda) or Watkins' Q(lambda) with tiles, for tasks with discrete actions.

    Args:
        settings: of the learner.
        axes: of the state; those that wrap have a period.
        actions: how many there are.
        seed: of its chance.

    Examples:
        >>> axes = Axis("x", "m", 0, 1), Axis("heading", "rad", -3.2, 3.2)
        >>> agent = TileCoder(TileConfig(tiles=(4, 4)), axes, actions=3)
        >>> agent.start(np.array([0.2, 1.0])) in (0, 1, 2)
        True
    """

    def __init__(self, settings: TileConfig, axes: Sequence[Axis], actions: int, seed: int = 0):
        self.settings, self.rng = settings, np.random.default_rng(seed)
        wraps = np.array([axis.period > 0 for axis in axes])
        self.low = np.array([axis.low for axis in axes])
        self.scale = np.array(settings.tiles) / [axis.high - axis.low for axis in axes]
        grids, moved = np.arange(settings.tilings)[:, None], np.array(MOVED[: len(axes)])
        self.offsets = grids * moved % settings.tilings / settings.tilings
        # A grid that does not wrap needs one tile more, where it was moved beyond the end.
        self.counts = np.array(settings.tiles) + ~wraps
        self.wraps = wraps
        strides = np.cumprod([1, *self.counts[:0:-1]])[::-1]
        self.strides, self.size = strides, int(self.counts.prod())
        self.grids = np.arange(settings.tilings) * self.size
        shape = settings.tilings * self.size, actions
        self.weights = np.full(shape, settings.initial / settings.tilings)
        self.traces = np.zeros(shape)

    def tiles(self, observation: NDArray[Any]) -> NDArray[np.int64]:
        """The tile of each grid in which an observation (n,) lies. Shape: (m,)."""
        place = np.floor((observation - self.low) * self.scale + self.offsets).astype(np.int64)
        place = np.where(self.wraps, place % self.counts, place.clip(0, self.counts - 1))
        return self.grids + place @ self.strides

    def start(self, observation: NDArray[Any]) -> int:
        """Begin a trial; the first action."""
        self.traces[:] = 0.0
        self.at = self.tiles(observation)
        return self._choose(self.weights[self.at].sum(0))

    def step(
        self,
        reward: float,
        observation: NDArray[Any],
        terminated: bool,
        truncated: bool = False,
    ) -> int | None:
        """Learn from the reward of the last action, then choose the next (None at the end)."""
        settings, at, action = self.settings, self.at, self.action
        decay = settings.gamma * settings.trace_decay
        self.traces *= decay if self.greedy or not settings.watkins else 0.0
        self.traces[at] = 0.0  # of the other actions there too (Singh and Sutton 1996)
        self.traces[at, action] = 1.0
        error = reward - self.weights[at, action].sum()
        chosen = None
        if not terminated:
            self.at = self.tiles(observation)
            values = self.weights[self.at].sum(0)
            chosen = self._choose(values)
            error += settings.gamma * (values.max() if settings.watkins else values[chosen])
        self.weights += settings.rate / settings.tilings * error * self.traces
        return None if truncated else chosen

    def act(self, observation: NDArray[Any]) -> int:
        """The greedy action."""
        return int(self.weights[self.tiles(observation)].sum(0).argmax())

    def _choose(self, values: NDArray[np.float64]) -> int:
        """The greedy action, of equal ones by chance, or now and then any."""
        best = np.flatnonzero(values == values.max())
        explores = self.rng.random() < self.settings.epsilon
        self.action = int(self.rng.integers(len(values)) if explores else self.rng.choice(best))
        self.greedy = bool(values[self.action] == values.max())
        return self.action
