"""Stable-Baselines3 in the maze (extra ``peers``), trial by trial like every other learner."""

import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray


class Scaled(gymnasium.ObservationWrapper):
    """Poses as networks like them: position in [-1, 1], cosine and sine of the heading."""

    def __init__(self, env: gymnasium.Env[Any, Any], size: float):
        super().__init__(env)
        self.size = size
        self.observation_space = gymnasium.spaces.Box(-1.5, 1.5, (4,), np.float32)

    def observation(self, observation: NDArray[Any]) -> NDArray[np.float32]:
        """The pose (x, y, heading) as four numbers."""
        x, y, heading = observation
        place = 2 * x / self.size - 1, 2 * y / self.size - 1
        return np.array([*place, np.cos(heading), np.sin(heading)], np.float32)


class Greedy:
    """What a model does without exploration."""

    def __init__(self, model: Any):
        self.model = model

    def act(self, observation: NDArray[Any]) -> int:
        """The action of a scaled observation."""
        return int(self.model.predict(observation, deterministic=True)[0])


def train(
    name: str,
    env: gymnasium.Env[Any, Any],
    settings: dict[str, Any],
    seed: int,
    decisions: int,
    over: Callable[[Any], bool],
) -> tuple[Greedy, gymnasium.Env[Any, Any]]:
    """Train until it is over or decisions are spent; the greedy policy and its environment.

    Args:
        name: ``dqn`` or ``ppo``.
        env: the maze with three actions.
        settings: of the algorithm.
        seed: of everything.
        decisions: at most so many.
        over: called with each trial.

    Raises:
        ValueError: Stable-Baselines3 is not installed.
    """
    try:
        from stable_baselines3 import DQN, PPO
        from stable_baselines3.common.callbacks import BaseCallback
    except ImportError:
        raise ValueError("dqn and ppo need Stable-Baselines3: pip install -e '.[peers]'") from None
    from sofnn_torch.studies.peers import Trial

    class Count(BaseCallback):
        taken = 0

        def _on_step(self) -> bool:
            self.taken += 1
            if not self.locals["dones"][0]:
                return True
            info, taken, self.taken = self.locals["infos"][0], self.taken, 0
            return not over(Trial(info["total_steps"], taken, info["success"], time.process_time()))

    scaled = Scaled(env, env.unwrapped.plan.size)  # type: ignore[attr-defined]
    algorithm = {"dqn": DQN, "ppo": PPO}[name]
    model = algorithm("MlpPolicy", scaled, seed=seed, device="cpu", **settings)
    model.learn(decisions, callback=Count())
    return Greedy(model), scaled
