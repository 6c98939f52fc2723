"""Learners with rules by chance, of every kind that can be exported."""

import dataclasses

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete

from sofnn_torch.export import runtime
from sofnn_torch.runs.factory import make_agent, make_env
from sofnn_torch.runs.settings import Config


class Sheet(gymnasium.Env):
    """A point that wanders: actions are a sheet of numbers, or count from -1."""

    observation_space = Box(-2, 2, (2,), np.float32)

    def __init__(self, discrete=False):
        high = np.array([[1, 2], [3, 4]], np.float32)
        self.action_space = Discrete(3, start=-1) if discrete else Box(-high, 2 * high)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.steps = self.np_random.uniform(-1, 1, 2), 0
        return self.place.astype(np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.steps += 1
        self.place = self.place + 0.1 * np.mean(action) + self.np_random.normal(0, 0.1, 2)
        return self.place.astype(np.float32), 1.0, False, self.steps == 60, {}


for kind in (False, True):
    gymnasium.register(
        f"Sheet{'Counted' * kind}-v0", entry_point=lambda kind=kind, **_: Sheet(kind)
    )

KINDS = {
    "three": {},
    "steer": {"maze": {"actions": "steer"}},
    "wheels": {"maze": {"actions": "wheels"}},
    "constant baseline": {"sga": {"baseline": "constant", "replays": 0}},
    "q": {"agent": "q"},
    "q scalar": {"agent": "q", "q": {"coding": "scalar"}},
    "q wheels": {"agent": "q", "q": {"coding": "wheels"}},
    "q antecedent": {"agent": "q", "q": {"coding": "antecedent"}},
    "q steer": {"agent": "q", "maze": {"actions": "steer"}, "q": {"segments": 5}},
    "car": {"env": "MountainCar-v0"},
    "pole q": {"env": "CartPole-v1", "agent": "q"},
    "pendulum": {"env": "Pendulum-v1"},
    "pendulum q": {"env": "Pendulum-v1", "agent": "q"},
    "sheet": {"env": "Sheet-v0"},
    "counted": {"env": "SheetCounted-v0"},
}
FEW = ("three", "wheels", "q scalar", "q antecedent", "pole q", "pendulum")  # each way to decide
ALL = [kind if kind in FEW else pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS]


def learner(kind="three", rules=40, seed=0, axes_only=False, steps=3000):
    """Settings and learner of a kind, with rules by chance in the range of its inputs.

    Args:
        kind: one of `KINDS`.
        rules: how many.
        seed: of the rules.
        axes_only: leave the consequents of the state (c_x) at zero, as the default rates do.
        steps: of a trial in the maze.
    """
    given = dict(KINDS[kind])
    names = {name: given.pop(name) for name in ("env", "agent") if name in given}
    if "env" in names:
        names["axes"] = ranged(names["env"])
        names["reward_scale"] = 0.01
    config = Config(**names)
    given["maze"] = {"max_steps": steps} | given.get("maze", {})
    parts = {k: dataclasses.replace(getattr(config, k), **v) for k, v in given.items()}
    config = dataclasses.replace(config, **parts)
    agent, rng = make_agent(config), np.random.default_rng(seed)
    low, high = (np.array([getattr(a, end) for a in agent.inputs]) for end in ("low", "high"))
    centres = rng.uniform(low, high, (rules, len(low)))
    widths = rng.uniform(0.06, 0.2, centres.shape) * (high - low)
    columns = []
    for output in agent.outputs:
        ends = (-1, 1) if output.name.startswith(("mu", "c ")) else (0.1, 1)
        values = rng.uniform(*ends, rules)
        if axes_only and output.name.removeprefix("c ") in {axis.name for axis in agent.task.axes}:
            values *= 0
        columns.append(values)
    table = [torch.tensor(part, dtype=torch.float32) for part in (centres, widths)]
    agent.net.replace_rules(*table, torch.tensor(np.array(columns).T, dtype=torch.float32))
    return config, agent


def ranged(env):
    """Axes for a task, with ends."""
    from sofnn_torch.tasks.env import look

    axes = look(env).axes
    return tuple((a.name, a.unit, max(a.low, -5), min(a.high, 5), a.period) for a in axes)


def states(agent, count, seed=1):
    """States by chance, some beyond the ends of their axes. Shape: (count, n)."""
    rng, axes = np.random.default_rng(seed), agent.task.axes
    low, high = (np.array([getattr(axis, end) for axis in axes]) for end in ("low", "high"))
    margin = 0.1 * (high - low)
    return rng.uniform(low - margin, high + margin, (count, len(low))).astype(np.float32)


def turns_north(path):
    """The policy in a file, which has the three rules of another tool and drives by them."""
    ours, (config, _) = runtime.read(path), learner("three", steps=400)
    weights = np.exp(-0.5 * ((np.array([0.0, 1.5708]) - 0.2) / 0.5) ** 2)
    west = np.exp(-0.5 * (0.9 / 0.2) ** 2) * weights[1]
    expected = weights[0] / (weights.sum() + west)
    assert ours.outputs([0.9, 0.5, 0.2])[0] == pytest.approx(expected, abs=1e-5)
    env = make_env(config)
    x, info = env.reset(seed=0, options={"pose": (0.15, 0.15, 0.0)})
    action = ours.start(x)
    for _ in range(6):
        x, _, _, _, info = env.step(action)
        action = ours.act(x)
    env.close()
    assert info["true_pose"][2] > 0.9  # it turned to the north
    return ours
