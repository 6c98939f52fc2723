"""What a run consists of: typed settings, the presets ``default`` and ``paper``, validation.

Every field is a flag of ``train.py``; the string under a field is its help text. ``make_env`` and
``make_agent`` turn the settings into the objects that a run uses, so that training, evaluation
and analysis cannot disagree.
"""

import dataclasses
import json
import math
import types
import typing
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import tyro

from sofnn_torch import qlearning, sga
from sofnn_torch.maze import KheperaMazeEnv
from sofnn_torch.qlearning import Coding, QLearning
from sofnn_torch.sga import SGA, Actions
from sofnn_torch.sofnn import SOFNN, Growth, grid

Agent = SGA | QLearning
PERIODS = (0.0, 0.0, 2 * math.pi)  # x and y do not wrap, the heading does


@dataclass(frozen=True)
class NetworkConfig:
    """Section 2: the fuzzy network."""

    theta: float = 0.4
    """Growth threshold theta_th of eq. 3: a rule is added where firing stays below it."""
    growth: Growth = "rule"
    """Reading of eq. 3; `frozen` never adds a rule."""
    width_position: float = 0.06
    """Width v of new membership functions on x and y, in metres."""
    width_heading: float = 0.45
    """Width v of new membership functions on the heading, in radians."""
    width_action: float = 0.3
    """Width v on the action, where the action is an antecedent (`--q.coding antecedent`)."""
    interpolate: bool = False
    """A new rule takes over the policy that the network had there (SGA), or the action values
    (Q-learning), instead of the initial ones."""
    grid: tuple[int, int, int] = (12, 12, 8)
    """Rules along x, y and heading of the fixed network (12 12 8 and 24 24 16 in the paper)."""
    grid_action: int = 8
    """Rules along the action of the fixed network, where the action is an antecedent."""
    max_rules: Annotated[int, tyro.conf.arg(aliases=["--max-rules"])] = 50_000
    """Hard limit; beyond it no rule is added and a warning is shown."""


@dataclass(frozen=True)
class SGAConfig:
    """Section 3: stochastic gradient ascent."""

    actions: Actions = "three"
    """`three`: right turn, straight, left turn; `steer`: one continuous action that blends them;
    `wheels`: two wheel speeds."""
    gamma: float = 0.99
    """Discount per decision."""
    trace_decay: float = 0.8
    """Lambda of the eligibility traces; 1 in the paper."""
    baseline: Literal["constant", "value"] = "value"
    """Reinforcement baseline b of eq. 7: the paper's constant, or a value learned by TD."""
    constant: float = 0.0
    """The constant baseline."""
    rate_mean: float = 30.0
    """Learning rate of the consequents mu."""
    rate_deviation: float = 10.0
    """Learning rate of the consequents sigma."""
    rate_centre: float = 0.0
    """Learning rate of the centres u; 0 leaves them where they were put."""
    rate_width: float = 0.0
    """Learning rate of the widths v; 0 leaves them as they are."""
    rate_value: float = 1.0
    """Learning rate of the value consequents (baseline `value`)."""
    one_minus_gamma: bool = False
    """Multiply the policy's learning rates by (1 - gamma), as eq. 8 prints."""
    variance_scaled: bool = True
    """Multiply eligibilities by sigma squared, which keeps steps bounded as sigma shrinks."""
    initial_value: float = 0.65
    """Value of an unknown state (baseline `value`); optimistic at the start of the maze."""
    sigma_initial: float = 0.3
    """Standard deviation of the first rule, and of new rules without interpolation."""
    sigma_min: float = 0.1
    """Lower bound of sigma."""
    sigma_max: float = 1.0
    """Upper bound of sigma."""
    mean_limit: float = 1.0
    """Bound of |mu|."""
    replays: int = 100
    """Batches of remembered decisions to learn from again at the beginning of each trial; 0 for
    none. Needs baseline `value`."""
    memory: int = 20_000
    """Decisions that are remembered."""


@dataclass(frozen=True)
class QConfig:
    """Section 4: Q-learning."""

    actions: Literal["three", "steer"] = "three"
    """`three`: right turn, straight, left turn; `steer`: one continuous action in J segments."""
    coding: Coding = "onehot"
    """Action vector of eq. 9: `scalar`, `wheels` (wheel speeds), `onehot`, or `antecedent` (the
    action also enters the rules' antecedents: the paper's fuzzy net - a)."""
    segments: int = 3
    """Number J of segments of the action range."""
    temperature: float = 0.05
    """Temperature T of the Boltzmann roulette, eq. 11."""
    gamma: float = 0.99
    """Discount per decision."""
    trace_decay: float = 0.8
    """Lambda of the eligibility traces; 0 in the paper."""
    trace_cut: bool = True
    """Clear the traces at an action that is not greedy (Watkins)."""
    trace_limit: float | None = 1.0
    """Bound of the consequents' traces; None for no bound."""
    value_limit: float | None = 100.0
    """Bound of the value of the following state in the TD error, the goal's reward; None for no
    bound."""
    rate_state: float = 0.0
    """Learning rate of c_x."""
    rate_action: float = 1.0
    """Learning rate of c_a."""
    rate_constant: float = 0.0
    """Learning rate of c."""
    rate_centre: float = 0.0
    """Learning rate of the centres u; 0 leaves them where they were put."""
    rate_width: float = 0.0
    """Learning rate of the widths v; 0 leaves them as they are."""
    initial: float = 65.0
    """Initial c of a rule, the value of an unknown state; optimistic at the start of the maze."""
    replays: int = 100
    """Batches of remembered decisions to learn from again at the beginning of each trial; 0 for
    none."""
    memory: int = 20_000
    """Decisions that are remembered."""


@dataclass(frozen=True)
class MazeConfig:
    """Section 5: robot and maze."""

    hold: int = 10
    """Steps that an action is held unless the robot bumps."""
    max_steps: int = 20_000
    """Steps after which a trial ends without the goal."""
    motor_noise: float = 0.1
    """Motor noise; 0.1 multiplies the forward speed by U(0.9, 1.1) in each step."""
    wheel_noise: Literal["common", "independent"] = "common"
    """One factor for the forward and one for the turning part, or one for each wheel."""
    dead_reckoning: Literal["guarded", "still", "literal"] = "guarded"
    """`guarded`: slides along a wall on a bump, inside the arena, reset at every pass of a sub-goal
    or the start; `still`: the same, but no advance on a bump; `literal`: the paper's."""
    goal_reward: float = 1.0
    """Reward at the goal."""
    collision_reward: float = -1e-4
    """Reward of a bump."""
    subgoal_reward: float = 0.0
    """Reward of a sub-goal, once per trial."""
    step_reward: float = 0.0
    """Reward of every decision."""
    wheel_radius_scale: float = 1.0
    """Miscalibration: true wheel radius over the one the robot believes in."""
    wheel_base_scale: float = 1.0
    """Miscalibration: true wheel base over the one the robot believes in."""


@dataclass(frozen=True)
class Config:
    """Train a robot to find its way with a self-organizing fuzzy neural network.

    Without flags: stochastic gradient ascent on a growing network. Watch with
    ``tensorboard --logdir runs``.
    """

    agent: Literal["sga", "q"] = "sga"
    """Learner: stochastic gradient ascent (section 3) or Q-learning (section 4)."""
    network: Literal["sofnn", "fixed"] = "sofnn"
    """Network: growing (SOFNN) or a regular grid of fixed structure (FSFNN)."""
    pose: Literal["estimated", "true", "odometry"] = "estimated"
    """What the robot knows of its pose: dead reckoning from commands, the truth, or from its
    wheel encoders."""
    preset: Literal["default", "paper"] = "default"
    """Settings that the other flags change: what works best, or every number as printed."""
    seed: int = 0
    """Seed of every random number of the run."""
    trials: int = 200
    """Trials to learn for."""
    net: NetworkConfig = field(default_factory=NetworkConfig)
    sga: SGAConfig = field(default_factory=SGAConfig)
    q: QConfig = field(default_factory=QConfig)
    maze: MazeConfig = field(default_factory=MazeConfig)

    def __post_init__(self) -> None:
        """Check every number; ValueError names the flag and its range."""
        validate(self)

    def to_json(self) -> str:
        """The settings as readable JSON."""
        return json.dumps(dataclasses.asdict(self), indent=2)


def preset(agent: str, network: str, name: str) -> Config:
    """The settings of a named preset for one of the four learners.

    Raises:
        ValueError: an unknown name.
    """
    if name not in ("default", "paper") or agent not in ("sga", "q"):
        raise ValueError(f"no preset {name!r} for agent {agent!r}")
    if name == "paper":
        return _paper(agent, network)
    net = NetworkConfig()
    if agent == "q":  # greedy action values need sharper sets: wide ones reach through walls
        net = NetworkConfig(theta=0.3, width_position=0.045, width_heading=0.4)
    if network == "fixed":  # half the grid's spacing
        net = dataclasses.replace(net, width_position=0.042, width_heading=0.39)
    if agent == "sga":
        return Config(agent="sga", network=network, net=net)
    return Config(
        agent="q",
        network=network,
        net=net,
        maze=MazeConfig(goal_reward=100.0, collision_reward=-0.1, subgoal_reward=0.5),
    )


def _paper(agent: str, network: str) -> Config:
    """Every number as printed; where the paper is silent, the reading of docs/paper.md."""
    net = NetworkConfig(theta=0.5)
    sga_settings = SGAConfig(
        trace_decay=1.0,
        baseline="constant",
        rate_mean=0.05,
        rate_deviation=0.001,
        rate_centre=0.001,
        rate_width=0.001,
        one_minus_gamma=True,
        variance_scaled=False,
        replays=0,
    )
    q_settings = QConfig(
        coding="antecedent",
        trace_decay=0.0,
        trace_cut=False,
        trace_limit=None,
        value_limit=None,
        rate_state=0.1,
        rate_action=0.1,
        rate_constant=0.1,
        rate_centre=0.001,
        rate_width=0.001,
        initial=0.0,
        replays=0,
    )
    rewards = (1.0, -1e-4) if agent == "sga" else (100.0, -0.1)
    maze = MazeConfig(
        dead_reckoning="literal",
        goal_reward=rewards[0],
        collision_reward=rewards[1],
        subgoal_reward=0.5,
    )
    return Config(
        agent, network, preset="paper", net=net, sga=sga_settings, q=q_settings, maze=maze
    )


def from_dict(data: Any, kind: Any = Config, where: str = "") -> Any:
    """Settings from plain data, as JSON or a checkpoint holds them.

    Entries that are not given take their default, so that files of older versions can be read.

    Raises:
        ValueError: one line on an unknown entry, a wrong type or a value out of range.
    """
    if not isinstance(data, dict):
        raise ValueError(f"{where or 'the settings'}: a table of names and values is needed")
    hints = typing.get_type_hints(kind)
    if unknown := sorted(str(name) for name in data.keys() - hints.keys()):
        raise ValueError(f"{where + unknown[0][:60]!r} is not a setting of this version")
    return kind(**{name: _typed(data[name], hints[name], f"{where}{name}") for name in data})


def _typed(value: Any, hint: Any, name: str) -> Any:
    """The value of one setting if it has the annotated type."""
    if dataclasses.is_dataclass(hint):
        return from_dict(value, hint, f"{name}.")
    choices, kind = typing.get_args(hint), typing.get_origin(hint)
    if kind is tuple and isinstance(value, list | tuple) and len(value) == len(choices):
        return tuple(_typed(v, h, name) for v, h in zip(value, choices, strict=True))
    if kind is Literal and isinstance(value, str) and value in choices:
        return value
    if kind is types.UnionType:
        return None if value is None else _typed(value, choices[0], name)
    if hint is float and type(value) in (int, float) and abs(value) < 1e300:
        return float(value)
    if hint in (int, bool, str) and type(value) is hint and (hint is not int or abs(value) < 2**63):
        return value
    wanted = " or ".join(map(str, choices)) if kind is Literal else getattr(hint, "__name__", hint)
    raise ValueError(f"{name} must be {wanted}, got {str(value)[:60]!r}")


POSITIVE = {"hold", "max_steps", "width_position", "width_heading", "width_action", "max_rules"}
POSITIVE |= {"grid", "grid_action", "segments", "temperature", "sigma_initial", "sigma_min"}
POSITIVE |= {"sigma_max", "mean_limit", "wheel_radius_scale", "wheel_base_scale", "trials"}
POSITIVE |= {"trace_limit", "memory"}
UNIT = {"gamma", "trace_decay"}  # in [0, 1]
NOT_NEGATIVE = {"seed", "replays"}
MOST = {"hold": 10_000, "segments": 1_000, "max_rules": 10_000_000, "memory": 10_000_000}
# Bounds of mu and sigma would hide a rate that makes a typical step longer than their range.
MOST |= {"rate_mean": 500, "rate_deviation": 500}


def validate(config: Any, prefix: str = "") -> None:
    """Check the numbers of a settings class and of those inside it.

    Raises:
        ValueError: one line that names the flag, the value and what is allowed.
    """
    for entry in dataclasses.fields(config):
        name, value = entry.name, getattr(config, entry.name)
        flag = f"--{prefix}{name}".replace("_", "-")
        if dataclasses.is_dataclass(value):
            validate(value, f"{name}.")
            continue
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, bool) or not isinstance(number, int | float):
                continue
            if not abs(number) < 1e300:
                raise ValueError(f"{flag} must be a finite number, got {number}")
            if number > MOST.get(name, math.inf):
                raise ValueError(f"{flag} must be at most {MOST[name]}, got {number}")
            if name in POSITIVE and number <= 0:
                raise ValueError(f"{flag} must be positive, got {number}")
            if (name in NOT_NEGATIVE or name.startswith("rate_")) and number < 0:
                raise ValueError(f"{flag} must not be negative, got {number}")
            if name in UNIT and not 0 <= number <= 1:
                raise ValueError(f"{flag} must lie in [0, 1], got {number}")
            if name == "theta" and not 0 < number < 1:
                raise ValueError(f"{flag} must lie between 0 and 1, got {number}")
            if name == "motor_noise" and not 0 <= number < 1:
                raise ValueError(f"{flag} must lie in [0, 1), got {number}")
    if isinstance(config, SGAConfig) and not (
        config.sigma_min <= config.sigma_initial <= config.sigma_max
    ):
        raise ValueError("need --sga.sigma-min <= --sga.sigma-initial <= --sga.sigma-max")
    if isinstance(config, SGAConfig) and config.replays and config.baseline == "constant":
        raise ValueError("--sga.replays needs --sga.baseline value: set --sga.replays 0")
    if isinstance(config, QConfig) and config.actions == "three" and config.segments != 3:
        raise ValueError("--q.actions three needs --q.segments 3")
    if isinstance(config, Config) and config.network == "fixed":
        shape, most = config.net.grid, config.net.max_rules
        if config.agent == "q" and config.q.coding == "antecedent":
            shape = (*shape, config.net.grid_action)
        if math.prod(shape) > most:
            raise ValueError(f"--net.grid {shape} has more rules than --net.max-rules {most}")


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
        settings = dataclasses.asdict(config.q)
        del settings["initial"]
        return QLearning(network, 3, seed=config.seed, **settings)
    settings = dataclasses.asdict(config.sga)
    del settings["sigma_initial"], settings["initial_value"]
    return SGA(network, seed=config.seed, **settings)
