"""Tasks whose inputs and actions have names, and ends where their spaces have none.

Names and units are those of Gymnasium's documentation. Ends are narrower than those of the space
where an episode ends earlier, or where no policy gets that far.
"""

import math
from dataclasses import dataclass
from typing import Any

from sofnn_torch.network.axes import Axis

STEP = 0.01  # a reward of 1 in every step for ever, discounted by 0.99, is then worth 1


@dataclass(frozen=True)
class Known:
    """What is known of a task.

    Attributes:
        axes: of its observation, all with ends.
        actions: names of its actions, or of the numbers that make one.
        reward_scale: of its rewards, so that values are about 1.
        best: the most, so scaled, that any state can be worth.
    """

    axes: tuple[Axis, ...]
    actions: tuple[str, ...]
    reward_scale: float = STEP
    best: float = 1.0


CAR = Axis("position", "", -1.2, 0.6), Axis("velocity", "", -0.07, 0.07)
ACROBOT = (
    *(Axis(f"{part} of angle {i}", "", -1, 1) for i in (1, 2) for part in ("cosine", "sine")),
    Axis("angular velocity 1", "rad/s", -4 * math.pi, 4 * math.pi),
    Axis("angular velocity 2", "rad/s", -9 * math.pi, 9 * math.pi),
)
PENDULUM = (
    Axis("cosine of angle", "", -1, 1),
    Axis("sine of angle", "", -1, 1),
    Axis("angular velocity", "rad/s", -8, 8),
)
LANDER = (
    Axis("x", "", -1, 1),
    Axis("y", "", -0.5, 1.5),
    Axis("speed x", "", -1, 1),
    Axis("speed y", "", -2, 1),
    Axis("angle", "rad", -1, 1),
    Axis("angular velocity", "", -2, 2),
    Axis("left leg down", "", 0, 1),
    Axis("right leg down", "", 0, 1),
)
POLE = (
    Axis("cart position", "", -2.4, 2.4),
    Axis("cart velocity", "", -3, 3),
    Axis("pole angle", "rad", -0.21, 0.21),
    Axis("pole velocity", "rad/s", -3, 3),
)

# Found by the trials that docs/tasks.md tells of; what is not here is the default.
TUNED: dict[str, dict[str, dict[str, Any]]] = {
    "MountainCar": {
        "net": {"width": (0.052,), "theta": 0.39},
        "q": {
            "rate_action": 0.52,
            "temperature": 0.0036,
            "trace_decay": 0.9,
            "action_gap": 0.85,
            "replay_every": 4,
        },
    },
    "MountainCarContinuous": {
        "net": {"width": (0.059,)},
        "q": {
            "initial": 0.93,
            "temperature": 0.0033,
            "trace_decay": 0.95,
            "action_gap": 0.7,
            "replay_every": 2,
        },
    },
    "CartPole": {
        "net": {"width": (0.116,), "theta": 0.395},
        "q": {
            "rate_action": 0.4,
            "temperature": 0.0068,
            "trace_decay": 0.95,
            "replay_every": 2,
        },
    },
    "Acrobot": {
        "net": {"width": (0.28, 0.28, 0.28, 0.28, 0.08, 0.06), "theta": 0.4},
        "q": {
            "initial": -0.2,
            "temperature": 0.0012,
            "rate_action": 0.3,
            "rate_constant": 0.3,
            "action_gap": 0.7,
            "replay_every": 2,
        },
    },
    "Pendulum": {
        "net": {"width": (0.1,), "theta": 0.5},
        "q": {
            "points": True,
            "initial": -0.5,
            "temperature": 0.02,
            "rate_action": 0.6,
            "trace_decay": 0.5,
            "replays": 100,
        },
    },
}

# By the name in Gymnasium's registry, without the version.
KNOWN = {
    "MountainCar": Known(CAR, ("push left", "no push", "push right"), best=0.0),
    "MountainCarContinuous": Known(CAR, ("push",)),
    "CartPole": Known(POLE, ("push left", "push right")),
    "Acrobot": Known(ACROBOT, ("torque -1", "no torque", "torque +1"), best=0.0),
    "Pendulum": Known(PENDULUM, ("torque",), STEP / 8, 0.0),  # a step costs 0 to 16.3
    "LunarLander": Known(LANDER, ("nothing", "left engine", "main engine", "right engine")),
    "LunarLanderContinuous": Known(LANDER, ("main engine", "side engines")),
}
