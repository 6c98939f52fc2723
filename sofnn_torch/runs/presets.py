"""Named settings: ``default``, what works best, and ``paper``, every number as printed.

In tasks other than the maze rewards are scaled so that values are about 1 (`sofnn_torch.tasks`),
which makes one ``default`` serve all of them.
"""

import math
from dataclasses import replace
from typing import Any

from sofnn_torch.learners.qlearning import QConfig
from sofnn_torch.learners.sga import SGAConfig
from sofnn_torch.maze.settings import MazeConfig
from sofnn_torch.network.settings import NetworkConfig
from sofnn_torch.tasks.env import Spaces

TABLES = ("net", "sga", "q", "maze")


def tables(agent: str, network: str, name: str) -> dict[str, Any]:
    """The tables of settings of a named preset for one of the four learners, or one's own."""
    return _paper(agent) if name == "paper" else _default(agent, network)


def task_tables(agent: str, network: str, found: Spaces) -> dict[str, Any]:
    """The tables of the preset ``default`` for a task with these spaces.

    The square of a distance grows with the number of inputs, and so do the squares of the widths
    beyond two inputs. A grid has about a thousand rules and widths of half its spacing. What a
    search found for a known task comes last (`sofnn_torch.tasks.known`).
    """
    inputs = len(found.axes)
    along = max(2, int(1000 ** (1 / inputs) + 1e-9))
    sharpness = 0.07 if agent == "q" else 0.1  # greedy values need sharp sets
    width = sharpness * max(1.0, math.sqrt(inputs / 2)) if network == "sofnn" else 0.5 / along
    net = NetworkConfig(
        theta=0.3 if agent == "q" else 0.4, width=(float(f"{width:.3g}"),), grid=(along,)
    )
    # A rule that fires alone for a whole trial is stable if rate_value < 2 (1 - gamma lambda).
    sga = SGAConfig(
        rate_value=0.3,
        rate_deviation=1.0,
        sigma_initial=1.0,
        sigma_min=0.3,
        initial_value=1.0,
        replays=20,
    )
    # Optimistic, but no more than a state can be worth: where every step costs something, 0 is.
    q = QConfig(
        temperature=0.002,
        trace_decay=0.9,
        rate_action=0.3,
        initial=found.best,
        value_limit=found.best,
        replays=20,
        replay_every=0,
    )
    q = replace(q, **found.tuned.get("q", {}))
    if agent == "q" and network == "sofnn":
        net = replace(net, **found.tuned.get("net", {}))
    return {"net": net, "sga": sga, "q": q, "maze": MazeConfig()}


def careful(tables: dict[str, Any]) -> dict[str, Any]:
    """The tables of a preset for a run that begins with a few wide rules, which know the way.

    A narrow rule among them is a plateau in what they say together, on which a robot may be caught:
    none is added. Replay, before the values are learned, learns that whatever was done was wrong. A
    rule that fires alone for a whole trial needs rate_value < 2 (1 - gamma lambda).
    """
    changes: dict[str, dict[str, Any]] = {
        "net": {"growth": "frozen"},
        "sga": {"replays": 0, "rate_value": 0.3},
        "q": {"replays": 0, "replay_every": 0},
    }
    return tables | {name: replace(tables[name], **part) for name, part in changes.items()}


def _default(agent: str, network: str) -> dict[str, Any]:
    theta, position, heading = 0.4, 0.06, 0.45
    if agent == "q":  # greedy action values need sharper sets: wide ones reach through walls
        theta, position, heading = 0.3, 0.045, 0.4
    if network == "fixed":  # half the grid's spacing
        position, heading = 0.042, 0.39
    maze = MazeConfig()
    if agent == "q":
        maze = MazeConfig(goal_reward=100.0, collision_reward=-0.1, subgoal_reward=0.5)
    net = NetworkConfig(theta=theta, width_position=position, width_heading=heading)
    return {"net": net, "sga": SGAConfig(), "q": QConfig(), "maze": maze}


def _paper(agent: str) -> dict[str, Any]:
    """Every number as printed; where the paper is silent, the reading of docs/paper.md."""
    sga = SGAConfig(
        trace_decay=1.0,
        baseline="constant",
        rate_mean=0.05,
        rate_deviation=0.001,
        rate_centre=0.001,
        rate_width=0.001,
        one_minus_gamma=True,
        variance_scaled=False,
        value_limit=None,
        replays=0,
    )
    q = QConfig(
        coding="antecedent",
        trace_decay=0.0,
        trace_cut=False,
        trace_limit=None,
        value_limit=None,
        action_gap=0.0,
        rate_state=0.1,
        rate_action=0.1,
        rate_constant=0.1,
        rate_centre=0.001,
        rate_width=0.001,
        initial=0.0,
        replays=0,
        replay_every=0,
    )
    goal, collision = (100.0, -0.1) if agent == "q" else (1.0, -1e-4)
    maze = MazeConfig(
        bumps="contact",
        landmarks="first",
        dead_reckoning="literal",
        goal_reward=goal,
        collision_reward=collision,
        subgoal_reward=0.5,
    )
    return {"net": NetworkConfig(theta=0.5), "sga": sga, "q": q, "maze": maze}
