"""A task of one's own for `train.py`: to park a cart at a mark, by pushing it back and forth.

    cp examples/own_task.py my_task.py
    python train.py --env my_task:Parking-v0 --agent q --trials 60

Any environment of Gymnasium will do that takes `render_mode`. The ends of its observations are the
ranges of the rules' inputs; `--axes` names them.
"""

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete

MARK, NEAR = 0.8, 0.05  # metres
PUSH, STEP = 1.0, 0.1  # m/s^2, seconds


class Parking(gymnasium.Env):
    """Observation: place [m] and speed [m/s]. Actions: push back, roll, push forth."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}
    observation_space = Box(np.array([0, -1], np.float32), np.array([1, 1], np.float32))
    action_space = Discrete(3)

    def __init__(self, render_mode: str | None = None):
        self.render_mode = render_mode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Stand somewhere in the left half."""
        super().reset(seed=seed)
        self.place, self.speed = self.np_random.uniform(0.0, 0.5), 0.0
        return self._seen(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Push for a tenth of a second; each step costs 1 until the cart rests at the mark."""
        self.speed = float(np.clip(self.speed + PUSH * STEP * (action - 1), -1, 1))
        self.place += self.speed * STEP
        if not 0 <= self.place <= 1:  # a buffer at either end
            self.place, self.speed = float(np.clip(self.place, 0, 1)), 0.0
        parked = abs(self.place - MARK) < NEAR and abs(self.speed) < 0.15
        return self._seen(), -1.0, parked, False, {}

    def render(self) -> np.ndarray:
        """The cart in black above the mark in green, for films. Shape: (32, 256, 3)."""
        picture = np.full((32, 256, 3), 255, np.uint8)
        for place, rows, colour in ((MARK, slice(24, 32), (0, 150, 0)), (self.place, slice(24), 0)):
            column = round(place * 240)
            picture[rows, column : column + 16] = colour
        return picture

    def _seen(self) -> np.ndarray:
        return np.array([self.place, self.speed], np.float32)


gymnasium.register("Parking-v0", Parking, max_episode_steps=200)
