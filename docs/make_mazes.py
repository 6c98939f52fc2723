"""Make the pictures of docs/mazes.md: python docs/make_mazes.py."""

from dataclasses import dataclass
from pathlib import Path

from sofnn_torch.maze.layouts import built_in
from sofnn_torch.maze.optimum import mean_optimum, optimal_steps
from sofnn_torch.maze.rendering import OffscreenRenderer
from sofnn_torch.maze.robot import Physics, load_model
from sofnn_torch.pictures import figures
from sofnn_torch.terminal import command

OUT = Path(__file__).parent / "images"
SIZE = 600  # pixels of a rendered picture
SEEDS = range(2)  # of the random mazes that are shown


@dataclass(frozen=True)
class Options:
    """Draw all mazes that are built in, with a shortest run, and print their optima."""


def main(_: Options) -> None:
    """Draw all mazes that are built in, with a shortest run, and print their optima."""
    names = [*built_in(), *(f"random:{seed}" for seed in SEEDS)]
    for name in names:
        physics = Physics(name)
        plan = physics.plan
        renderer = OffscreenRenderer(load_model(name), SIZE, SIZE)
        picture = renderer.draw(physics.data.qpos)
        renderer.close()
        figure, (seen, drawn) = figures.canvas(2, 2.8, 2.8)
        seen.imshow(picture)
        seen.set_axis_off()
        figures.maze_plan(plan, drawn)
        if not plan.anywhere:
            path = optimal_steps(plan, resolution=0.005).path
            drawn.plot([x for x, _, _ in path], [y for _, y, _ in path], color=figures.BLUE)
        (OUT / f"maze-{name.replace(':', '-')}.png").write_bytes(figures.png(figure, dpi=100))
        print(f"{name}: {mean_optimum(plan):.0f} steps", flush=True)


if __name__ == "__main__":
    command(main, Options, __doc__)
