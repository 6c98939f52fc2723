"""A reward and an observation of one's own, by wrappers of Gymnasium.

    python examples/own_reward.py

A pendulum is rewarded for its height, and seen by its angle: one input that wraps instead of a
cosine and a sine.
"""

import math

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from sofnn_torch import SGA, Axis

AXES = [Axis("angle", "rad", -math.pi, math.pi, period=2 * math.pi), Axis("speed", "rad/s", -8, 8)]


class Height(gymnasium.RewardWrapper):
    """Rewards the height of the tip, from -1 to 1, after each step."""

    def reward(self, reward: float) -> float:
        """The height, whatever the reward was."""
        return math.cos(self.unwrapped.state[0])


class Angle(gymnasium.ObservationWrapper):
    """Shows angle and speed."""

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        ends = np.array([math.pi, 8.0], np.float32)
        self.observation_space = Box(-ends, ends)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """Angle and speed from cosine, sine and speed."""
        cosine, sine, speed = observation
        return np.array([math.atan2(sine, cosine), speed], np.float32)


def main(trials: int = 10) -> None:
    """Learn for some trials of 200 steps, and say the mean height in the first and the last."""
    env = Angle(Height(gymnasium.make("Pendulum-v1")))
    agent = SGA.for_env(env, seed=0, axes=AXES, reward_scale=0.01)
    heights = [record.reward / record.steps for record in agent.learn(env, trials=trials)]
    print(f"mean height {heights[0]:.2f} in the first trial, {heights[-1]:.2f} in the last")


if __name__ == "__main__":
    main()
