"""Films of a learned policy."""

import contextlib
import io
import itertools
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sofnn_torch.learners.frozen import FrozenPolicy
from sofnn_torch.learners.learner import Learner
from sofnn_torch.maze.rendering import OffscreenRenderer
from sofnn_torch.maze.robot import load_model
from sofnn_torch.runs import seeding
from sofnn_torch.runs.factory import make_maze, make_task
from sofnn_torch.runs.settings import MAZE, Config


def film(config: Config, agent: Learner, **options: Any) -> Iterator[NDArray[np.uint8]]:
    """Frames of one trial without learning.

    Args:
        config: settings of the run.
        agent: the learner; only its random generator moves, and is set back.
        **options: ``seed``, ``explore``, ``plain`` and ``limit``, and in the maze also
            ``steps_per_frame`` and ``size``, see `maze_film`.

    Raises:
        ValueError: the task cannot be drawn here.
        RenderingError: this machine cannot draw the maze.
    """
    return (maze_film if config.env == MAZE else task_film)(config, agent, **options)


def task_film(
    config: Config,
    agent: Learner,
    seed: int = 0,
    explore: bool = False,
    plain: bool = False,
    limit: int = 20_000,
) -> Iterator[NDArray[np.uint8]]:
    """Frames as the environment draws them, one for each step."""
    env = make_task(config, "rgb_array")
    rng = agent.rng  # a film must not change the training
    try:
        seeding.begin(env, agent, seed)
        observation, _ = env.reset()  # as in a series of trials, where only the first is seeded
        policy, over = FrozenPolicy(agent, explore, plain), False
        yield env.render()
        while not over and env.steps < limit:
            observation, _, terminated, truncated, _ = env.step(policy.act(observation))
            over = terminated or truncated
            yield env.render()
    finally:
        agent.rng = rng
        env.close()


def maze_film(
    config: Config,
    agent: Learner,
    seed: int = 0,
    explore: bool = False,
    plain: bool = False,
    steps_per_frame: int = 2,
    limit: int = 20_000,
    size: int = 480,
) -> Iterator[NDArray[np.uint8]]:
    """Frames (size, size, 3) of a trial in the maze.

    Args:
        config: settings of the run.
        agent: the learner.
        seed: seed of the motor noise and of the policy's chance.
        explore: sample the stochastic policy.
        plain: without the cure for loops.
        steps_per_frame: simulator steps from one frame to the next.
        limit: steps after which the film ends.
        size: width and height of the frames in pixels.

    Raises:
        RenderingError: this machine cannot draw.
    """
    env = make_maze(config)
    renderer = OffscreenRenderer(load_model(env.settings.layout), size, size)
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
        policy = FrozenPolicy(agent, explore, plain)
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


def mp4(frames: Iterator[NDArray[np.uint8]], frames_per_second: int = 30) -> bytes:
    """A film in H.264.

    Raises:
        OSError: there is no encoder, or it failed; the message says why.
    """
    first = next(frames)
    height, width, _ = first.shape
    raw = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {frames_per_second} -i -"
    coded = "-an -c:v libx264 -crf 25 -pix_fmt yuv420p"
    with tempfile.TemporaryDirectory() as place, tempfile.TemporaryFile() as messages:
        file = Path(place) / "film.mp4"
        try:
            command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error"]
            command += [*raw.split(), *coded.split(), str(file)]
            encoder = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=messages)
        except (OSError, RuntimeError) as error:
            raise OSError(f"no film: ffmpeg cannot be started ({error})") from None
        try:
            # The stubs do not know that there is a pipe.
            with contextlib.suppress(BrokenPipeError), encoder.stdin as pipe:  # type: ignore[union-attr]
                for frame in itertools.chain([first], frames):
                    pipe.write(frame.tobytes())
        finally:
            encoder.wait()
        if encoder.returncode:
            messages.seek(0)
            said = messages.read().decode(errors="replace").strip().splitlines()
            raise OSError(f"no film: ffmpeg failed ({said[0] if said else encoder.returncode})")
        return file.read_bytes()
