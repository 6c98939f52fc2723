"""From settings to objects, one way for all: training, evaluation and analysis cannot disagree."""

import dataclasses
import math

from sofnn_torch.learners import qlearning, sga
from sofnn_torch.learners.qlearning import QLearning
from sofnn_torch.learners.sga import SGA
from sofnn_torch.maze.env import KheperaMazeEnv
from sofnn_torch.network.axes import Axis
from sofnn_torch.network.sofnn import SOFNN, grid
from sofnn_torch.runs.settings import Config

Agent = SGA | QLearning
POSE = (
    Axis("x", "m", 0.0, 1.0),
    Axis("y", "m", 0.0, 1.0),
    Axis("heading", "rad", -math.pi, math.pi, period=2 * math.pi),
)
ACTION = Axis("action", "", -1.0, 1.0)


def make_env(config: Config, render_mode: str | None = None) -> KheperaMazeEnv:
    """The maze that the settings describe."""
    actions = config.sga.actions if config.agent == "sga" else config.q.actions
    maze = dataclasses.asdict(config.maze)
    return KheperaMazeEnv(pose=config.pose, actions=actions, render_mode=render_mode, **maze)


def make_agent(config: Config) -> Agent:
    """The learner and its network that the settings describe, with no rule learned yet."""
    net, widths = config.net, [config.net.width_position] * 2 + [config.net.width_heading]
    axes, shape = POSE, net.grid
    if config.agent == "q":
        outputs = 3 + qlearning.code_length(config.q.coding, config.q.segments) + 1
        initial = [0.0] * (outputs - 1) + [config.q.initial]
        interpolate = net.interpolate
        if config.q.coding == "antecedent":
            widths, axes, shape = (
                [*widths, net.width_action],
                (*axes, ACTION),
                (*shape, net.grid_action),
            )
    else:
        m = sga.n_actions(config.sga.actions)
        initial = [0.0] * m + [config.sga.sigma_initial] * m
        learned = config.sga.baseline == "value"
        initial += [config.sga.initial_value] * learned
        # An unknown state keeps its initial value: optimism is what makes the robot explore.
        interpolate = [net.interpolate] * 2 * m + [False] * learned
    common = {"width": widths, "initial": initial}
    if config.network == "fixed":
        network = grid(axes, shape, len(initial), **common)
    else:
        network = SOFNN(
            axes,
            len(initial),
            theta=net.theta,
            growth=net.growth,
            interpolate=interpolate,
            max_rules=net.max_rules,
            **common,
        )
    if config.agent == "q":
        return QLearning(network, 3, config.q, config.seed)
    return SGA(network, config.sga, config.seed)
