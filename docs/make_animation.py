"""Make the animation of the README: four trials of one run, side by side.

python train.py --trials 100 --checkpoint-every 1 --keep 101 --name film
python docs/make_animation.py runs/film
"""

import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from matplotlib.axes import Axes
from PIL import Image

from sofnn_torch.learners.learner import Learner
from sofnn_torch.maze.plan import MazePlan
from sofnn_torch.pictures import figures
from sofnn_torch.runs import checkpoint
from sofnn_torch.runs.factory import make_agent, make_env
from sofnn_torch.runs.session import arithmetic, saved_config
from sofnn_torch.terminal import command
from sofnn_torch.training import play

OUT = Path(__file__).parent / "images" / "learning.gif"
STEPS_PER_FRAME, LAST, STILL = 10, 900, 2500  # steps, steps, milliseconds at the end


@dataclass(frozen=True)
class Options:
    """Play the trials again and film them."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Directory of the run, with the checkpoint before each of the trials."""
    trials: tuple[int, ...] = (1, 10, 40, 100)
    """The trials."""


@dataclass
class Filmed:
    """A trial: where the robot was and how many rules it had, step by step."""

    trial: int
    plan: MazePlan
    places: list[Any] = field(default_factory=list)
    headings: list[float] = field(default_factory=list)
    rules: list[int] = field(default_factory=list)
    centres: Any = None


@arithmetic()
def film(run: Path, trial: int) -> Filmed:
    """Learn a trial again, bit for bit, from the checkpoint before it."""
    config, path = saved_config(run), run / f"checkpoint-{trial - 1}.pt"
    agent, env = make_agent(config), make_env(config)
    checkpoint.restore(path, checkpoint.load(path), agent, env)
    return watched(agent, env, trial)


def watched(agent: Learner, env: Any, trial: int) -> Filmed:
    """Learn a trial, and note it step by step."""
    filmed = Filmed(trial, env.plan)

    def note() -> None:
        filmed.places.append(env.physics.position())
        filmed.headings.append(env.physics.pose()[2])
        filmed.rules.append(agent.net.n_rules)

    env.on_simulator_step = note
    play(env, agent)
    env.close()
    filmed.centres = agent.net.centres.numpy()[:, :2].copy()
    return filmed


def draw(filmed: Filmed, step: int, ax: Axes) -> None:
    """One trial after so many steps."""
    figures.maze_plan(filmed.plan, ax, labels=False)
    ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
    now = min(step, len(filmed.places)) - 1
    places = np.array(filmed.places[: now + 1])
    rules = filmed.rules[now]
    ax.plot(*filmed.centres[:rules].T, ".", color="0.62", markersize=2.6, zorder=3)
    ax.plot(*places.T, color=figures.BLUE, linewidth=1.4, zorder=4)
    x, y = places[-1]
    ax.plot(x, y, "o", color=figures.VERMILION, markersize=9, zorder=6)
    tip = 0.035 * np.array([np.cos(filmed.headings[now]), np.sin(filmed.headings[now])])
    ax.plot([x, x + tip[0]], [y, y + tip[1]], color="white", linewidth=1.6, zorder=7)
    arrived = step >= len(filmed.places)
    ax.set_title(f"trial {filmed.trial}", fontsize=12, fontweight="bold")
    ax.set_xlabel(f"{'goal after ' * arrived}{now + 1:,} steps\n{rules} rules", fontsize=10)


def main(options: Options) -> None:
    """Play the trials again and film them."""
    trials = [film(options.run, trial) for trial in options.trials]
    frames = []
    for step in range(STEPS_PER_FRAME, LAST + 1, STEPS_PER_FRAME):
        figure, axes = figures.canvas(len(trials), 2.3, 2.85, tight=False)
        figure.subplots_adjust(left=0.005, right=0.995, top=0.93, bottom=0.13, wspace=0.03)
        for filmed, ax in zip(trials, axes, strict=True):
            draw(filmed, step, ax)
        picture = Image.open(io.BytesIO(figures.png(figure, dpi=100))).convert("RGB")
        frames.append(picture.quantize(48, dither=Image.Dither.NONE))
    times = [60] * (len(frames) - 1) + [STILL]
    frames[0].save(
        OUT, save_all=True, append_images=frames[1:], duration=times, loop=0, optimize=True
    )
    print(f"{OUT}: {len(frames)} frames, {OUT.stat().st_size / 1e6:.2f} MB")
    for filmed in trials:
        print(f"trial {filmed.trial}: {len(filmed.places):,} steps, {filmed.rules[-1]} rules")


if __name__ == "__main__":
    command(main, Options, __doc__)
