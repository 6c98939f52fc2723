"""A learner and a growth criterion of one's own: what tests/test_own.py plugs into the package."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch

from sofnn_torch.bounds import Positive, Settings, Share, Within
from sofnn_torch.learners import Learner, Output
from sofnn_torch.network.growth import Criterion, Place


@dataclass(frozen=True)
class SarsaConfig(Settings, table="own"):
    """Sarsa(0) with an epsilon-greedy policy, one consequent for each action."""

    rate: Positive = 0.5
    gamma: Share = 0.99
    epsilon: Annotated[float, Within(least=0, most=1)] = 0.1
    initial: float = 0.5


class Sarsa(Learner):
    """Sutton and Barto, 2nd edition, section 6.4, with rules in the place of states."""

    name = "sarsa"
    Settings = SarsaConfig

    @classmethod
    def layout(cls, settings, task):
        """An action value for each discrete action."""
        return task.axes, tuple(Output(f"Q {name}", settings.initial) for name in task.actions)

    def start(self, observation):
        """Forget the action that was to follow the last trial."""
        self.next = None
        return super().start(observation)

    def act(self, observation, explore=0):
        """The greedy action, or an epsilon-greedy one."""
        with torch.no_grad():
            return self._draw(self.net(self._tensor(observation)[None])[0].tolist(), explore)

    def alone(self, conclusions):
        """The best action of each rule."""
        return conclusions.argmax(1)

    def _draw(self, values, explore=1):
        if self.rng.random() < min(1, explore * self.settings.epsilon):
            return int(self.rng.integers(len(values)))
        return int(np.argmax(values))

    def _choose(self, x, firing):
        values = self.net.conclude(firing).tolist() if self.next is None else self.next[0]
        action = self._draw(values) if self.next is None else self.next[1]
        gradient = torch.zeros_like(self.net.consequents.T)
        gradient[action] = firing
        self.net.accumulate(gradient, 0.0)
        self.value, self.next = values[action], None
        self._log["firing"].append(self.net.max_firing)
        return action

    def _error(self, reward, x=None, firing=None):
        if firing is None:
            return reward - self.value
        values = self.net.conclude(firing).tolist()
        self.next = values, self._draw(values)
        return reward + self.settings.gamma * values[self.next[1]] - self.value

    def _learn(self, error):
        self._log["error"].append(error)
        self.net.adapt(torch.full((len(self.outputs), 1), self.settings.rate), error)

    def _policy(self, x):
        value, best = self.net(x).max(1)
        return best, value


class Pairs(Criterion):
    """A rule where fewer than two rules fire by theta."""

    def place(self, net, x, squares, log_firing, best):
        """At the state itself."""
        return Place(x) if (log_firing >= self.log_theta).sum() < 2 else None


class Greedy(Criterion):
    """No criterion: it does not say where."""
