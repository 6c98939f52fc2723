"""From settings to objects, one way for all: training, evaluation and analysis cannot disagree."""

import dataclasses

from sofnn_torch.learners.learner import Learner
from sofnn_torch.maze.env import KheperaMazeEnv
from sofnn_torch.network.sofnn import SOFNN, grid
from sofnn_torch.runs.settings import Config


def make_env(config: Config, render_mode: str | None = None) -> KheperaMazeEnv:
    """The maze that the settings describe."""
    maze = dataclasses.asdict(config.maze)
    return KheperaMazeEnv(pose=config.pose, render_mode=render_mode, **maze)


def make_agent(config: Config) -> Learner:
    """The learner and its network that the settings describe, with no rule learned yet."""
    net, settings = config.net, config.learner_settings
    axes, outputs = config.learner.layout(settings, config.task)
    widths = [net.width_position, net.width_position, net.width_heading, net.width_action]
    common = {
        "width": widths[: len(axes)],
        "initial": [output.initial for output in outputs],
    }
    if config.network == "fixed":
        shape = (*net.grid, net.grid_action)[: len(axes)]
        network = grid(axes, shape, len(outputs), **common)
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
