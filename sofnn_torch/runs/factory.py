"""From settings to objects, one way for all: training, evaluation and analysis cannot disagree."""

import dataclasses

from sofnn_torch.learners.learner import Learner
from sofnn_torch.maze.env import KheperaMazeEnv
from sofnn_torch.network.sofnn import SOFNN, grid
from sofnn_torch.runs.settings import MAZE, Config
from sofnn_torch.tasks.env import TaskEnv, make


def make_env(config: Config, render_mode: str | None = None) -> KheperaMazeEnv | TaskEnv:
    """The maze that the settings describe, or another task."""
    if config.env != MAZE:
        return make(config.env, config.task.axes, render_mode)
    maze = dataclasses.asdict(config.maze)
    return KheperaMazeEnv(pose=config.pose, render_mode=render_mode, **maze)


def make_agent(config: Config) -> Learner:
    """The learner and its network that the settings describe, with no rule learned yet."""
    net, settings = config.net, config.learner_settings
    axes, outputs = config.learner.layout(settings, config.task)
    common = {"width": config.widths, "initial": [output.initial for output in outputs]}
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
