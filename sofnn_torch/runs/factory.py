"""From settings to objects, one way for all: training, evaluation and analysis cannot disagree."""

import dataclasses
from typing import Any

from sofnn_torch.learners.learner import Learner
from sofnn_torch.maze.env import KheperaMazeEnv
from sofnn_torch.maze.plan import MazePlan
from sofnn_torch.maze.robot import plan_of
from sofnn_torch.network.sofnn import SOFNN, grid
from sofnn_torch.runs.settings import MAZE, Config
from sofnn_torch.tasks.env import TaskEnv, make

Environment = KheperaMazeEnv | TaskEnv


def make_env(config: Config, render_mode: str | None = None) -> Environment:
    """The maze that the settings describe, or another task."""
    return (make_maze if config.env == MAZE else make_task)(config, render_mode)


def make_maze(config: Config, render_mode: str | None = None) -> KheperaMazeEnv:
    """The maze of settings for it."""
    maze = dataclasses.asdict(config.maze)
    return KheperaMazeEnv(pose=config.pose, render_mode=render_mode, **maze)


def make_task(config: Config, render_mode: str | None = None) -> TaskEnv:
    """The environment of settings for a task other than the maze."""
    return make(config.env, config.task.axes, render_mode)


def make_plan(config: Config) -> MazePlan:
    """The maze of settings for it as seen from above."""
    return plan_of(config.maze.layout)


def make_agent(config: Config) -> Learner:
    """The learner and its network that the settings describe, with no rule learned yet."""
    net, settings = config.net, config.learner_settings
    axes, outputs = config.learner.layout(settings, config.task)
    common: dict[str, Any] = {
        "width": config.widths,
        "initial": [output.initial for output in outputs],
    }
    if config.env != MAZE:  # some tasks measure in units of which a thousandth is a long way
        common["min_width"] = min(1e-3, min(config.widths) / 100)
    if config.network == "fixed":
        network = grid(axes, config.grid, len(outputs), **common)
    else:
        network = SOFNN(
            axes,
            len(outputs),
            theta=net.theta,
            growth=net.growth,
            interpolate=[net.interpolate and output.interpolates for output in outputs],
            max_rules=net.max_rules,
            **common,
        )
    return config.learner(network, config.task, settings, config.seed)
