"""Numbers that diverge: found, told, and made an end of."""

import math
from typing import Any, Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from sofnn_torch.learners.learner import Learner
from sofnn_torch.network.axes import Axis

FARTHEST = 100.0  # in any unit; no rule so far outside the range of its input ever fires
WIDEST = 50.0  # times the width of a new rule: it fires everywhere and no more rules are added
LARGEST = 1e9  # no reward and no step size that make sense lead to a consequent beyond this
FAILURES = (ArithmeticError, RuntimeError, ValueError, StopIteration)
WARNINGS = ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL", "CONTACTFULL", "CNSTRFULL", "INERTIA")


class Divergence(ArithmeticError):
    """Numbers stopped being finite or sensible; the message says which."""


class Watch:
    """Looks for numbers that diverge while a trial is played, and says where they did.

    Args:
        agent: the learner.
        env: the environment, whose physics may warn.
        observation: the last one.

    Raises:
        Divergence: on leaving, or on a `check`.
    """

    def __init__(self, agent: Learner, env: Any, observation: NDArray[Any]):
        self.agent, self.env, self.observation = agent, env, observation

    def check(self, reward: float) -> None:
        """Look at the last decision: one sum stands for all, which is finite if all terms are."""
        if not math.isfinite(sum(self.observation.tolist(), reward + self.agent.value)):
            raise Divergence(self._diagnosis() or "a value estimate is not finite")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: Any, error: BaseException | None, _: object) -> None:
        # Code that meets a NaN fails in its own ways; what matters is where the NaN is.
        if isinstance(error, Divergence) or not isinstance(error, (*FAILURES, type(None))):
            return
        warnings = physics_warnings(self.env) if error is None else ""
        if what := warnings or self._diagnosis():
            raise Divergence(what) from error

    def _diagnosis(self) -> str:
        return diagnose(self.agent, self.observation)


def diagnose(agent: Learner, observation: np.ndarray) -> str:
    """What is not finite, or beyond all sense, in a learner or its input; empty if nothing is."""
    if not np.isfinite(observation).all():
        return f"the observation is {observation.tolist()}"
    net = agent.net
    if net.n_rules == 0:
        return ""
    parts = {
        "centres": (net.centres, net.centres.new_tensor([*map(farthest, agent.inputs)])),
        "widths": (net.widths, WIDEST * net.default_width),
        "consequents": (net.consequents, LARGEST),
        "eligibility traces": (net.traces.T, math.inf),
    }
    for name, (values, limit) in parts.items():
        bad = ~(values.abs() < limit).all(1)  # a NaN is not smaller than anything
        if bad.any():
            rule = int(bad.nonzero()[0])
            worst = ", ".join(f"{value:.3g}" for value in values[rule].tolist())
            count = f"{int(bad.sum())} of {net.n_rules} rules"
            return f"{name} of {count}, as in rule {rule + 1}: {worst}"
    return ""


def farthest(axis: Axis) -> float:
    """Where no centre on an axis makes sense any more."""
    ends = [abs(end) for end in (axis.low, axis.high) if math.isfinite(end)]
    return max([FARTHEST, *(10 * end for end in ends)])


def physics_warnings(env: Any) -> str:
    """MuJoCo's warnings since the last reset that make a simulation worthless; empty if none."""
    physics = getattr(env.unwrapped, "physics", None)
    if physics is None:
        return ""
    counts = physics.data.warning.number
    kinds = {name: getattr(mujoco.mjtWarning, f"mjWARN_{name}").value for name in WARNINGS}
    found = [f"{name} x {counts[kind]}" for name, kind in kinds.items() if counts[kind]]
    return f"MuJoCo warns of {', '.join(found)}" if found else ""
