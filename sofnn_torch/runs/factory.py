"""From settings to objects, one way for all: training, evaluation and analysis cannot disagree."""

import dataclasses
from collections.abc import Sequence
from typing import Any

from sofnn_torch.learners.learner import Learner, Task
from sofnn_torch.maze.env import KheperaMazeEnv
from sofnn_torch.maze.plan import MazePlan
from sofnn_torch.maze.robot import plan_of
from sofnn_torch.network.settings import NetworkConfig
from sofnn_torch.network.sofnn import SOFNN, grid
from sofnn_torch.runs import rule_files
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
    """The learner and its network that the settings describe, before the first trial."""
    agent = assemble(
        config.learner,
        config.task,
        config.learner_settings,
        config.net,
        config.widths,
        config.grid if config.network == "fixed" else None,
        config.seed,
        least=1e-3 if config.env == MAZE else least_width(config.widths),
    )
    if config.rules:
        _give_rules(agent, config)
    return agent


def _give_rules(agent: Learner, config: Config) -> None:
    """Let a learner begin with the rules of its settings, and new rules with what these conclude.

    Raises:
        ValueError: rules that this learner cannot have.
    """
    net, is_json = agent.net, config.rules.lstrip().startswith("{")
    try:
        table = rule_files.parse(config.rules, rule_files.schema(agent), is_json)
    except ValueError as error:
        raise ValueError(f"--rules: {error}") from None
    rule_files.put(agent, table)
    net.given, net.given_rate = len(table), config.rules_rate
    # A rule with neutral consequents would take its place from the rules around it.
    net.interpolate.fill_(True)
    net.interpolates = True


def least_width(widths: Sequence[float]) -> float:
    """Bound of the widths in any task: some measure in units of which 0.001 is a long way."""
    return min(1e-3, min(widths) / 100)


def assemble(
    learner: type[Learner],
    task: Task,
    settings: Any,
    net: NetworkConfig,
    widths: Sequence[float],
    along: Sequence[int] | None,
    seed: int,
    least: float,
) -> Learner:
    """A learner on a network of its own.

    Args:
        learner: its class.
        task: what is learned.
        settings: of the learner.
        net: settings of the network.
        widths: of new membership functions on each input of the network.
        along: rules along each input for a fixed network; None for a growing one.
        seed: of the learner.
        least: no width becomes smaller.

    Raises:
        ValueError: settings that do not go together.
    """
    axes, outputs = learner.layout(settings, task)
    common: dict[str, Any] = {
        "width": widths,
        "initial": [output.initial for output in outputs],
        "min_width": least,
    }
    if along is not None:
        network = grid(axes, along, len(outputs), **common)
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
    return learner(network, task, settings, seed)
