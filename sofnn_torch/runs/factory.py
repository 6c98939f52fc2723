"""From settings to objects, one way for all: training, evaluation and analysis cannot disagree."""

import dataclasses
import math

from sofnn_torch.learners import qlearning, sga
from sofnn_torch.learners.qlearning import QLearning
from sofnn_torch.learners.sga import SGA
from sofnn_torch.maze.env import KheperaMazeEnv
from sofnn_torch.network.sofnn import SOFNN, grid
from sofnn_torch.runs.settings import Config

Agent = SGA | QLearning
PERIODS = (0.0, 0.0, 2 * math.pi)  # x and y do not wrap, the heading does


def make_env(config: Config, render_mode: str | None = None) -> KheperaMazeEnv:
    """The maze that the settings describe."""
    actions = config.sga.actions if config.agent == "sga" else config.q.actions
    maze = dataclasses.asdict(config.maze)
    return KheperaMazeEnv(pose=config.pose, actions=actions, render_mode=render_mode, **maze)


def make_agent(config: Config) -> Agent:
    """The learner and its network that the settings describe, with no rule learned yet."""
    net, widths = config.net, [config.net.width_position] * 2 + [config.net.width_heading]
    lows, highs, shape, periods = [0.0, 0.0, -math.pi], [1.0, 1.0, math.pi], list(net.grid), PERIODS
    if config.agent == "q":
        outputs = 3 + qlearning.code_length(config.q.coding, config.q.segments) + 1
        initial = [0.0] * (outputs - 1) + [config.q.initial]
        interpolate = net.interpolate
        if config.q.coding == "antecedent":
            widths, periods = [*widths, net.width_action], (*periods, 0.0)
            lows, highs, shape = [*lows, -1.0], [*highs, 1.0], [*shape, net.grid_action]
    else:
        m = sga.n_actions(config.sga.actions)
        initial = [0.0] * m + [config.sga.sigma_initial] * m
        learned = config.sga.baseline == "value"
        initial += [config.sga.initial_value] * learned
        # An unknown state keeps its initial value: optimism is what makes the robot explore.
        interpolate = [net.interpolate] * 2 * m + [False] * learned
    common = {"width": widths, "periods": periods, "initial": initial}
    if config.network == "fixed":
        network = grid(lows, highs, shape, len(initial), **common)
    else:
        network = SOFNN(
            len(widths),
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
