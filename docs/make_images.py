"""Make the pictures of the README from a run: python docs/make_images.py RUN."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sofnn_torch.evaluate import load
from sofnn_torch.learners.frozen import FrozenPolicy
from sofnn_torch.maze.rendering import OffscreenRenderer
from sofnn_torch.maze.robot import load_model
from sofnn_torch.pictures import figures
from sofnn_torch.runs import seeding
from sofnn_torch.runs.factory import make_env
from sofnn_torch.terminal import command

OUT = Path(__file__).parent / "images"
SIZE = 840  # pixels of a rendered picture


@dataclass(frozen=True)
class Options:
    """Play one trial and draw the robot, its path and its policy."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Directory of the run."""


def main(options: Options) -> None:
    """Play one trial and draw the robot, its path and its policy."""
    config, agent, _, _ = load(options.run)
    env = make_env(config)
    renderer = OffscreenRenderer(load_model(), SIZE, SIZE)
    trail: list[tuple[float, float]] = []
    env.on_simulator_step = lambda: trail.append(env.physics.position())
    seeding.begin(env, agent, 1000)
    observation, _ = env.reset()  # the first trial that `evaluate` plays
    policy, over, close_up = FrozenPolicy(agent), False, None
    while not over:
        observation, _, terminated, truncated, _ = env.step(policy.act(observation))
        over = terminated or truncated
        if close_up is None and len(trail) > 120:
            close_up = renderer.draw(env.physics.data.qpos, trail, camera="chase")
    from_above = renderer.draw(env.physics.data.qpos, trail)

    figure, (robot, path, policy) = figures.canvas(3)
    for ax, picture in ((robot, close_up), (path, from_above)):
        ax.imshow(picture, extent=(0, 1, 0, 1))
        ax.set_axis_off()
    figures.action_field(env.plan, agent, policy)
    policy.set_axis_off()  # as large as the pictures beside it
    OUT.mkdir(exist_ok=True)
    (OUT / "learned.png").write_bytes(figures.png(figure, dpi=180))
    renderer.close()
    env.close()


if __name__ == "__main__":
    command(main, Options, __doc__)
