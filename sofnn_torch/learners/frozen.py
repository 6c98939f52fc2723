"""A learned policy that plays a trial without learning, and does not run in circles."""

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sofnn_torch.learners.learner import Action, Learner
from sofnn_torch.network.axes import Axis

NEAR = 1 / 40  # of the range of each input: states so near to each other count as one
MOST = 10  # doublings: by then every action is about as likely


def nearness(axes: Sequence[Axis]) -> list[float]:
    """How near two states must be to count as one, along each axis; inf for one without ends."""
    return [NEAR * (axis.high - axis.low) for axis in axes]


class FrozenPolicy:
    """The policy of a learner, for one trial.

    While a robot learns, values that lead it in a circle or against a wall are soon corrected.
    Frozen values are not, and a policy without chance would go on for ever. But a policy that for
    15 decisions in a row (`Task.patience`) comes to no state where it has not been in the trial is
    wrong there by more than the present chance covers. With each further one the learned standard
    deviation (eq. 5) or temperature (eq. 11) is added 1, 3, 7, ... times at the rule that fires
    most, where it stays until the end of the trial. A policy on its way is not changed. In tasks
    other than the maze patience is endless: there is no such cure.

    Args:
        agent: the learner; only its random generator moves.
        explore: begin with the learned stochastic policy instead of the mean or greedy action.
        plain: do without the cure.

    Attributes:
        freed: how many decisions had more chance than the policy gives them.

    Examples:
        >>> import gymnasium
        >>> from sofnn_torch import SGA
        >>> agent = SGA.for_env("Pendulum-v1", seed=0)
        >>> observation, _ = gymnasium.make("Pendulum-v1").reset(seed=0)
        >>> _ = agent.start(observation)
        >>> FrozenPolicy(agent.learner).act(observation).shape
        (1,)
    """

    def __init__(self, agent: Learner, explore: bool = False, plain: bool = False):
        self.agent, self.explore = agent, explore
        self.patience = math.inf if plain else agent.task.patience
        axes = agent.task.axes
        self._near = np.array(nearness(axes))
        self._turning = [(i, axis.period) for i, axis in enumerate(axes) if axis.period]
        self._seen, self._idle, self.freed = np.empty((0, len(axes))), 0, 0
        self._returns: Counter[int] = Counter()

    def start(self, observation: NDArray[Any]) -> Action:
        """The first action of the trial."""
        return self.act(observation)

    def step(
        self, reward: float, observation: NDArray[Any], terminated: bool, truncated: bool = False
    ) -> Action | None:
        """The next action, as `Learner.step`; None at the end."""
        return None if terminated or truncated else self.act(observation)

    def act(self, observation: NDArray[Any]) -> Action:
        """The action at an observation (n,)."""
        known = self.patience < math.inf and not self._is_new(observation)
        self._idle = self._idle + 1 if known else 0
        stuck, doublings = self._idle >= self.patience, 0
        if stuck or self._returns:
            rule = self.agent.strongest_rule(observation)
            self._returns[rule] += stuck
            doublings = min(self._returns[rule], MOST)
            self.freed += doublings > 0
        return self.agent.act(observation, self.explore + 2**doublings - 1)

    def _is_new(self, observation: NDArray[Any]) -> bool:
        """Whether no state of the trial is near the observation (n,), which then becomes one."""
        apart = self._seen - observation
        for i, period in self._turning:
            apart[:, i] -= period * np.round(apart[:, i] / period)
        new = not (((apart / self._near) ** 2).sum(1) <= 1).any()
        if new:
            self._seen = np.vstack([self._seen, observation])
        return new
