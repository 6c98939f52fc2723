"""The studies of ``python -m sofnn_torch.studies``: what is trained and under which settings.

An arm is a table of settings. ``agent``, ``network`` and ``preset`` choose a preset, every other
entry changes it, and a `Times` scales it; so arms follow a preset that is improved later.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

from sofnn_torch.runs import preset_files
from sofnn_torch.runs.directory import flatten
from sofnn_torch.runs.settings import Config, from_dict

Arm = dict[str, Any]
CHOICE = ("agent", "network", "preset")  # entries that choose a preset


class Times(NamedTuple):
    """A factor on the preset's value."""

    factor: float


@dataclass(frozen=True)
class Study:
    """Arms that belong together, and what is made of them.

    Attributes:
        title: heading of the page.
        about: what is compared, in Markdown.
        arms: settings by name.
        figures: draw the paper's figures and judge its claims.
        conditions: play the learned policies in other conditions too.
    """

    title: str
    about: str
    arms: dict[str, Arm]
    figures: bool = False
    conditions: bool = False


LEARNERS: dict[str, Arm] = {"sga": {"agent": "sga"}, "q": {"agent": "q"}}


def _four(poses: tuple[str, ...], common: Arm) -> dict[str, Arm]:
    return {
        f"{agent}-{network}-{pose}": {"agent": agent, "network": network, "pose": pose} | common
        for pose in poses
        for agent in LEARNERS
        for network in ("sofnn", "fixed")
    }


def _variants(common: dict[str, Arm], own: dict[str, dict[str, Arm]]) -> dict[str, Arm]:
    """For each learner its preset, then each change alone."""
    preset: dict[str, Arm] = {"default": {}}
    return {
        f"{agent}-{name}": base | change
        for agent, base in LEARNERS.items()
        for name, change in (preset | own[agent] | common).items()
    }


def _adapt(agent: str, rate: float = 0.001) -> Arm:
    """Centres and widths learn too, at the paper's rate or another."""
    return {f"{agent}.rate_centre": rate, f"{agent}.rate_width": rate}


SLOWLY = 1e-7  # values of 100 where 1 was meant make a step on antecedents 100^2 times larger


# Each help of the preset `default` taken away alone; then every other number of interest.
HELPS: dict[str, dict[str, Arm]] = {
    "sga": {
        "no-replay": {"sga.replays": 0},
        "replays-times-0.2": {"sga.replays": 20},
        "replay-each-decision": {"sga.replays": 0, "sga.replay_every": 1},
        "no-value-baseline": {"sga.baseline": "constant", "sga.replays": 0},
        "no-optimism": {"sga.initial_value": 0.0},
        "goal-as-optimism": {"sga.initial_value": 1.0},
        "sigma-min-0.03": {"sga.sigma_min": 0.03},
        "no-variance-scaling": {
            "sga.variance_scaled": False,
            # The same step at the initial sigma.
            "sga.rate_mean": Times(0.09),
            "sga.rate_deviation": Times(0.09),
        },
        "interpolation": {"net.interpolate": True},
        "one-minus-gamma": {"sga.one_minus_gamma": True},
        "lambda-0": {"sga.trace_decay": 0.0},
        "lambda-0.5": {"sga.trace_decay": 0.5},
        "lambda-0.95": {"sga.trace_decay": 0.95},
        "lambda-1": {"sga.trace_decay": 1.0},
        "gamma-0.95": {"sga.gamma": 0.95},
        "gamma-0.999": {"sga.gamma": 0.999},
        "adapt-centres-widths": _adapt("sga"),
        "adapt-slowly": _adapt("sga", SLOWLY),
        "subgoal-reward": {"maze.subgoal_reward": 0.5},
        "action-steer": {"maze.actions": "steer"},
    },
    "q": {
        "no-replay": {"q.replays": 0, "q.replay_every": 0},
        "replay-each-trial": {"q.replays": 100, "q.replay_every": 0},
        "replay-each-decision": {"q.replays": 0, "q.replay_every": 1},
        "no-optimism": {"q.initial": 0.0},
        "goal-as-optimism": {"q.initial": 100.0},
        "no-optimism-step-cost": {"q.initial": 0.0, "maze.step_reward": -1.0},
        "shared-constant": {"q.rate_action": 0.5, "q.rate_constant": 0.5},
        "no-trace-cut": {"q.trace_cut": False},
        "no-trace-limit": {"q.trace_limit": None},
        "no-value-limit": {"q.value_limit": None},
        "no-action-gap": {"q.action_gap": 0.0},
        "interpolation": {"net.interpolate": True},
        "coding-wheels": {"q.coding": "wheels"},
        "coding-scalar": {"q.coding": "scalar"},
        "coding-antecedent": {"q.coding": "antecedent"},
        "rate-times-0.1": {"q.rate_action": Times(0.1)},
        "lambda-0": {"q.trace_decay": 0.0},
        "lambda-0.5": {"q.trace_decay": 0.5},
        "lambda-0.95": {"q.trace_decay": 0.95},
        "lambda-1": {"q.trace_decay": 1.0},
        "gamma-0.95": {"q.gamma": 0.95},
        "gamma-0.999": {"q.gamma": 0.999},
        "adapt-centres-widths": _adapt("q"),
        "adapt-slowly": _adapt("q", SLOWLY),
        "no-subgoal-reward": {"maze.subgoal_reward": 0.0},
        "temperature-times-10": {"q.temperature": Times(10)},
    },
}
NETWORK: dict[str, Arm] = {
    "growth-input": {"net.growth": "input"},
    "growth-literal": {"net.growth": "literal"},
    "theta-times-0.5": {"net.theta": Times(0.5)},
    "theta-times-1.5": {"net.theta": Times(1.5)},
    "width-times-0.7": {"net.width_position": Times(0.7), "net.width_heading": Times(0.7)},
    "width-times-1.4": {"net.width_position": Times(1.4), "net.width_heading": Times(1.4)},
}


# What the robot is told of its pose: each piece of information given or taken away alone.
TOLD: dict[str, Arm] = {
    "exact-bumps": {"maze.bumps": "contact"},
    "exact-infrared": {"maze.infrared_noise": 0.0},
    "landmarks-position": {"maze.landmarks": "position"},
    "landmarks-first": {"maze.landmarks": "first"},
    "landmarks-inside": {"maze.landmarks": "inside"},
    "no-right-angles": {"maze.right_angles": False},
    "still": {"maze.dead_reckoning": "still"},
    "literal": {"maze.dead_reckoning": "literal"},
    "as-printed": {
        "maze.bumps": "contact",
        "maze.landmarks": "first",
        "maze.dead_reckoning": "literal",
    },
    "encoders": {"pose": "odometry"},
    "true-pose": {"pose": "true"},
}


def _search(agent: str) -> dict[str, Arm]:
    """The search over settings of the fixed network, the same for both learners."""
    base = {"agent": agent, "network": "fixed"}
    fine = {"net.grid": (24, 24, 16)}
    slowly = _adapt(agent, SLOWLY)
    arms = {"default": {}, "adapt-centres-widths": _adapt(agent), "adapt-slowly": slowly}
    for factor in (0.7, 1.4, 2.0):
        widths = dict.fromkeys(("net.width_position", "net.width_heading"), Times(factor))
        arms[f"width-times-{factor}"] = widths
        arms[f"width-times-{factor}-adapt"] = widths | _adapt(agent)
        arms[f"width-times-{factor}-adapt-slowly"] = widths | slowly
    for factor in (0.5, 1.0):
        widths = dict.fromkeys(("net.width_position", "net.width_heading"), Times(factor))
        arms[f"grid-24-24-16-width-times-{factor}"] = fine | widths
    return {f"{agent}-{name}": base | change for name, change in arms.items()}


STUDIES: dict[str, Study] = {
    "section5": Study(
        "Section 5 of the paper",
        "Both learners on the growing network (SOFNN) and on the network of fixed structure "
        "(FSFNN), with the estimated and with the true pose. Presets `default`.",
        _four(("estimated", "true"), {}),
        figures=True,
    ),
    "paper": Study(
        "The preset `paper`: every number as printed",
        "Both learners on both networks with the literal settings of the paper; where the paper "
        "is silent, with the readings listed in [paper.md](../paper.md). Nothing is tuned.",
        _four(("estimated",), {"preset": "paper"}),
        figures=True,
    ),
    "growth": Study(
        "When to add a rule",
        "The three readings of equation 3: `rule`, `input` and `literal`.",
        {
            f"{agent}-{growth}": base | {"net.growth": growth}
            for agent, base in LEARNERS.items()
            for growth in ("rule", "input", "literal")
        },
    ),
    "ablation": Study(
        "What each help and each number brings",
        "One change at a time against the preset `default`, growing network, estimated pose.",
        _variants(NETWORK, HELPS),
    ),
    "sensors": Study(
        "What the robot is told of its pose",
        "One piece of information given or taken away at a time against the preset `default`, in "
        "which the robot knows what its wheels were told, what its infrared sensors report, that "
        "walls stand at right angles, where it starts, and its pose on entering a sub-goal.",
        _variants(TOLD, {agent: {} for agent in LEARNERS}),
    ),
    "fixed": Study(
        "The fixed network, tuned fairly",
        "The same search for both learners: widths of the membership functions, held or trained "
        "with their centres (at the paper's rate, and at one that suits rewards of 100), and the "
        "finer grid. FSFNN, estimated pose.",
        _search("sga") | _search("q"),
    ),
    "robustness": Study(
        "Learned policies in other conditions",
        "The policies that were learned with the estimated pose in the normal maze (motor noise "
        "10 %, calibrated wheels, fixed start), played without learning where one thing differs.",
        _four(("estimated",), {}),
        conditions=True,
    ),
}


def settings(arm: Arm, seed: int = 0, **changes: Any) -> Config:
    """The settings of an arm.

    Args:
        arm: the arm.
        seed: seed of the run.
        changes: more entries like those of an arm, over it.

    Raises:
        ValueError: an entry that is no setting, or a value out of range.
    """
    arm = {"seed": seed} | arm | changes
    base = Config(**{name: arm[name] for name in CHOICE if name in arm})
    before = flatten(dataclasses.asdict(base))
    for name, value in arm.items():
        if isinstance(value, Times):
            arm[name] = value.factor * before[name]
    return preset_files.make(arm)


def changed(arm: Arm) -> str:
    """What an arm changes against the preset that it starts from, as flags of ``train.py``."""
    given = preset_files.differences(settings(arm))
    return preset_files.flags({k: v for k, v in given.items() if k not in CHOICE})


def essence(config: Config) -> Config:
    """The settings without those that have no effect in this run, to find runs that are equal."""
    data, defaults = (dataclasses.asdict(c) for c in (config, Config()))
    data["preset"] = defaults["preset"]
    for name in config.idle():
        table, _, entry = name.partition(".")
        if entry:
            data[table][entry] = defaults[table][entry]
        else:
            data[table] = defaults[table]
    return from_dict(data)
