"""Tile coding against tiles counted by hand and dynamic programming."""

import numpy as np
import pytest

from sofnn_torch.network.axes import Axis
from sofnn_torch.studies.tiles import TileCoder, TileConfig

LINE = (Axis("x", "m", 0, 1),)
RING = (Axis("x", "m", 0, 1), Axis("heading", "rad", 0, 4, 4))


def test_grids_are_moved_by_parts_of_a_tile():
    coder = TileCoder(TileConfig(tilings=2, tiles=(4,)), LINE, actions=1)
    # Tiles are 0.25 m long, and the second grid, of numbers 5 to 9, begins half a tile earlier.
    seen = {x: coder.tiles(np.array([x])).tolist() for x in (0.0, 0.124, 0.126, 0.9, 1.0, 7.0)}
    assert seen == {
        0.0: [0, 5],
        0.124: [0, 5],
        0.126: [0, 6],
        0.9: [3, 9],
        1.0: [4, 9],
        7.0: [4, 9],
    }


def test_an_axis_with_a_period_has_no_end():
    coder = TileCoder(TileConfig(tilings=1, tiles=(2, 4)), RING, actions=1)
    first, around, before = (coder.tiles(np.array([0.1, a]))[0] for a in (0.5, 4.5, -0.5))
    assert first == around != before == coder.tiles(np.array([0.1, 3.5]))[0]
    assert len({coder.tiles(np.array([x, a]))[0] for x in (0.1, 0.6) for a in range(4)}) == 8


@pytest.mark.parametrize("watkins", [True, False])
def test_values_of_a_corridor_are_those_of_dynamic_programming(watkins):
    settings = TileConfig(
        tilings=1, tiles=(5,), rate=0.2, gamma=0.9, epsilon=0.1, watkins=watkins, trace_decay=0.5
    )
    agent = TileCoder(settings, LINE, actions=2, seed=1)
    for _ in range(400):  # five cells, action 1 to the right, the goal beyond the last
        cell, action = 0, agent.start(np.array([0.1]))
        while action is not None:
            cell = max(cell - 1, 0) if action == 0 else cell + 1
            action = agent.step(float(cell == 5), np.array([0.1 + 0.2 * cell]), cell == 5)
    exact = 0.9 ** np.arange(4, -1, -1)  # of the way to the right
    found = agent.weights[:5, 1]
    np.testing.assert_allclose(found, exact, rtol=1e-3 if watkins else 0.15)
    assert [agent.act(np.array([0.1 + 0.2 * cell])) for cell in range(5)] == [1] * 5


def test_traces_are_one_where_the_action_was_taken_and_fade():
    settings = TileConfig(1, (4,), rate=0.5, trace_decay=0.5, gamma=0.8, initial=0.0)
    agent = TileCoder(settings, LINE, actions=1)
    agent.start(np.array([0.1]))
    agent.step(0.0, np.array([0.4]), False)
    assert agent.step(1.0, np.array([0.6]), False, truncated=True) is None
    np.testing.assert_allclose(agent.traces[:4, 0], [0.4, 1, 0, 0])
    np.testing.assert_allclose(agent.weights[:4, 0], [0.5 * 0.4, 0.5, 0, 0])
