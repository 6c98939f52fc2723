"""Films of a learned policy."""

import io
from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sofnn_torch.learners.frozen import FrozenPolicy
from sofnn_torch.learners.learner import Learner
from sofnn_torch.maze.rendering import OffscreenRenderer
from sofnn_torch.maze.robot import load_model
from sofnn_torch.runs import seeding
from sofnn_torch.runs.factory import make_env
from sofnn_torch.runs.settings import Config


def film(
    config: Config,
    agent: Learner,
    seed: int = 0,
    explore: bool = False,
    steps_per_frame: int = 2,
    limit: int = 20_000,
    size: int = 480,
) -> Iterator[NDArray[np.uint8]]:
    """Frames (size, size, 3) of one trial without learning.

    Args:
        config: settings of the run.
        agent: the learner.
        seed: seed of the motor noise and of the policy's chance.
        explore: sample the stochastic policy.
        steps_per_frame: simulator steps from one frame to the next.
        limit: steps after which the film ends.
        size: width and height of the frames in pixels.

    Raises:
        RenderingError: this machine cannot draw.
    """
    env = make_env(config)
    renderer = OffscreenRenderer(load_model(), size, size)
    for effect in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
        renderer.scene.flags[effect] = 0  # four fifths of the time where there is no GPU
    trail: list[tuple[float, float]] = []
    frames: list[NDArray[np.uint8]] = []

    def shoot() -> None:
        frames.append(renderer.draw(env.physics.data.qpos, trail, env.estimator.pose))

    def after_step() -> None:
        trail.append(env.physics.position())
        if len(trail) % steps_per_frame == 0:
            shoot()

    rng = agent.rng  # a film must not change the training
    try:
        seeding.begin(env, agent, seed)
        policy = FrozenPolicy(agent, explore)
        observation, _ = env.reset()  # as in a series of trials, where only the first is seeded
        env.on_simulator_step, over = after_step, False
        shoot()
        while not over and len(trail) < limit:
            observation, _, terminated, truncated, _ = env.step(policy.act(observation))
            over = terminated or truncated
            if over and len(trail) % steps_per_frame:
                shoot()
            yield from frames
            frames.clear()
    finally:
        agent.rng = rng
        renderer.close()
        env.close()


def gif(frames: Iterator[NDArray[np.uint8]], frames_per_second: int = 12) -> bytes:
    """An animation that TensorBoard shows among its images."""
    pictures = [Image.fromarray(frame).quantize(64) for frame in frames]
    buffer = io.BytesIO()
    pictures[0].save(
        buffer,
        format="GIF",
        save_all=True,
        append_images=pictures[1:],
        duration=1000 // frames_per_second,
        loop=0,
    )
    return buffer.getvalue()
