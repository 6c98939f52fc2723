"""A learned policy that plays a trial without learning, and does not run in circles."""

from collections import Counter
from typing import Any

from numpy.typing import NDArray

from sofnn_torch.learners.learner import Action, Learner

MOST = 10  # doublings: by then every action is about as likely


class FrozenPolicy:
    """The policy of a learner, for one trial.

    While a robot learns, values that lead it in a circle or against a wall are soon corrected.
    Frozen values are not, and a policy without chance would go on for ever. But to decide again and
    again where the same rule fires most says that they are wrong by more than the present chance
    covers: with each such decision after the fourth (`Task.patience`) the learned standard
    deviation (eq. 5), or temperature (eq. 11), is added 1, 3, 7, ... times at that rule until the
    end of the trial. A policy that goes straight to the goal leaves a rule sooner and is not
    changed by this. In tasks other than the maze patience is endless: there is no such cure.

    Args:
        agent: the learner; only its random generator moves.
        explore: begin with the learned stochastic policy instead of the mean or greedy action.

    Examples:
        >>> import gymnasium
        >>> from sofnn_torch import SGA
        >>> agent = SGA.for_env("Pendulum-v1", seed=0)
        >>> observation, _ = gymnasium.make("Pendulum-v1").reset(seed=0)
        >>> _ = agent.start(observation)
        >>> FrozenPolicy(agent.learner).act(observation).shape
        (1,)
    """

    def __init__(self, agent: Learner, explore: bool = False):
        self.agent, self.explore = agent, explore
        self.visits: Counter[int] = Counter()

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
        rule = self.agent.strongest_rule(observation)
        self.visits[rule] += 1
        doublings = min(max(self.visits[rule] - self.agent.task.patience, 0), MOST)
        return self.agent.act(observation, self.explore + 2**doublings - 1)
