"""The neutral form of a learned policy: plain data that every format is written from."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete

from sofnn_torch.export import runtime
from sofnn_torch.learners.frozen import MOST, nearness
from sofnn_torch.learners.learner import Learner
from sofnn_torch.maze.odometry import FORWARD_SPEED, STEP_SECONDS, TURN_SPEED, WHEEL_BASE
from sofnn_torch.network.axes import Axis
from sofnn_torch.runs.factory import make_plan, make_task
from sofnn_torch.runs.rule_files import shortest
from sofnn_torch.runs.settings import MAZE, Config

RUNTIME = "sofnn_runtime.py"  # what the copy beside a policy is called


def describe(config: Config, agent: Learner) -> dict[str, Any]:
    """All that a policy needs to be played without this package, as plain data.

    Raises:
        ValueError: the learner does not say how its outputs become actions.
    """
    patience, maze, task = agent.task.patience, config.env == MAZE, agent.task
    data: dict[str, Any] = {
        "format": runtime.FORMAT,
        "version": runtime.VERSION,
        "task": config.env,
        "learner": agent.name,
        "precision": str(agent.net.default_width.dtype).removeprefix("torch."),
        "axes": plain_axes(task.axes),
        "clipped": not maze,
        "actions": list(task.actions),
        "discrete": task.discrete,
        "outputs": [output.name for output in agent.outputs],
        "decision": agent.decoding(),
        "patience": patience if math.isfinite(patience) else None,
        "near": [d if math.isfinite(d) else None for d in nearness(task.axes)],
        "doublings": MOST,
        "command": _maze_command(config) if maze else _task_command(config),
    }
    if maze:
        data["robot"] = {
            "start": list(make_plan(config).start),
            "hold": config.maze.hold,
            "seconds": STEP_SECONDS,
            "wheel_base": WHEEL_BASE,
        }
    table = shortest(agent.net.table().detach().T.numpy())
    n = agent.net.n_inputs
    parts = (table[:, :n].tolist(), table[:, n : 2 * n].tolist(), table[:, 2 * n :].tolist())
    data["rules"] = [dict(zip(runtime.PARTS, row, strict=True)) for row in zip(*parts, strict=True)]
    return data


def plain_axes(axes: Sequence[Axis]) -> list[dict[str, Any]]:
    """Axes for JSON, which knows no infinity: None where there is no end."""
    return [
        {
            "name": axis.name,
            "unit": axis.unit,
            "low": axis.low if math.isfinite(axis.low) else None,
            "high": axis.high if math.isfinite(axis.high) else None,
            "period": axis.period,
        }
        for axis in axes
    ]


def to_json(data: dict[str, Any]) -> bytes:
    """The file of a policy, with one rule on a line."""
    head = json.dumps({k: v for k, v in data.items() if k != "rules"}, indent=1)
    head, rules = head.removesuffix("\n}"), map(json.dumps, data["rules"])
    return (head + ',\n "rules": [\n  ' + ",\n  ".join(rules) + "\n ]\n}\n").encode()


def from_json(path: Path) -> dict[str, Any]:
    """The policy in a file that `to_json` wrote.

    Raises:
        ValueError: one line on what is wrong with it.
    """
    return runtime.read(path).data


def runtime_source() -> bytes:
    """The file that plays a policy with NumPy alone."""
    return Path(runtime.__file__).read_bytes()


def _maze_command(config: Config) -> dict[str, Any]:
    """Wheel speeds [m/s] of an action."""
    if config.maze.actions == "wheels":
        return {"kind": "wheels", "forward": FORWARD_SPEED}
    return {"kind": "steer", "forward": FORWARD_SPEED, "turn": TURN_SPEED}


def _task_command(config: Config) -> dict[str, Any]:
    """The action of the environment itself for one of a learner."""
    env = make_task(config)
    space = env.env.action_space
    env.close()
    if isinstance(space, Discrete):
        return {"kind": "number", "first": int(space.start)}
    assert isinstance(space, Box)  # others are refused before a run begins
    ends = {"low": space.low, "high": space.high}
    flat = {name: np.ravel(end).astype(float).tolist() for name, end in ends.items()}
    return {"kind": "box", **flat, "shape": list(space.shape), "type": str(space.dtype)}
