"""How well a learned policy copes when the world is not the one that it was trained in."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from sofnn_torch import evaluate
from sofnn_torch.maze.env import KheperaMazeEnv
from sofnn_torch.runs import seeding
from sofnn_torch.runs.factory import make_maze
from sofnn_torch.runs.settings import Config
from sofnn_torch.training import play

EPISODES = 10
START_SPREAD = (0.03, 0.03, math.radians(20))  # m, m, rad: half-widths of the scattered start

# Group -> value on its axis -> what is changed.
CONDITIONS: dict[str, dict[float, dict[str, float]]] = {
    "motor noise [%]": {n: {"motor_noise": n / 100} for n in (0, 5, 10, 15, 20, 25, 30)},
    "wheel radius believed - true [%]": {
        d: {"wheel_radius_scale": 1 + d / 100} for d in (-3, -1.5, 0, 1.5, 3)
    },
    "wheel base believed - true [%]": {
        d: {"wheel_base_scale": 1 + d / 100} for d in (-3, -1.5, 0, 1.5, 3)
    },
    "scatter of the start [% of 30 mm, 20 degrees]": {s: {"start": s / 100} for s in (0, 50, 100)},
}


class ScatteredStart(gymnasium.Wrapper):
    """Begins every trial near the start, uniformly within `spread` times `START_SPREAD`."""

    def __init__(self, env: KheperaMazeEnv, spread: float, seed: int):
        super().__init__(env)
        self.start, self.spread = np.array(env.plan.start), spread
        self.rng = np.random.default_rng(seeding.stream("start", seed))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin a trial; the robot is told where it stands, as at every pass of the start."""
        offset = self.spread * np.array(START_SPREAD) * self.rng.uniform(-1, 1, 3)
        return self.env.reset(seed=seed, options={"pose": tuple(self.start + offset)})


def changed_maze(config: Config, change: dict[str, float], seed: int) -> gymnasium.Env:
    """The maze of a run with one condition changed."""
    maze: dict[str, Any] = {name: value for name, value in change.items() if name != "start"}
    env = make_maze(dataclasses.replace(config, maze=dataclasses.replace(config.maze, **maze)))
    return ScatteredStart(env, change["start"], seed) if change.get("start") else env


def under_conditions(path: Path) -> list[dict[str, Any]]:
    """Play the policy of a finished run in every condition, without learning.

    Returns:
        One row for each condition and policy: the means over `EPISODES` trials.
    """
    config, agent, _, _ = evaluate.load(path)
    rows = []
    for group, values in CONDITIONS.items():
        for value, change in values.items():
            for policy in ("greedy", "sampled"):
                seed = 2000 + config.seed
                env = changed_maze(config, change, seed)
                seeding.begin(env, agent, seed)
                records = [
                    play(env, agent, learn=False, explore=policy == "sampled")[0]
                    for _ in range(EPISODES)
                ]
                env.close()
                row = {"group": group, "value": value, "policy": policy}
                for quantity in ("success", "steps", "collisions"):
                    numbers = [record.row()[quantity] for record in records]
                    row[quantity] = round(float(np.mean(numbers)), 4)
                rows.append(row)
    return rows
