"""Speed of a full training run over that of its physics alone.

A run with everything on (learning, monitoring, checkpoints) is timed from its first trial to its
last checkpoint, then a bare loop of `mj_step` calls with the same model and the wheel commands
recorded from that run. Both alternate in one process; ratios are medians over the repeats. The
learner starts with the stated number of rules and nothing learned, so that half of its decisions
end at a wall, after some 5 steps instead of 10: the dearest phase of a run. Each row is measured
with the experience replay of the presets and without it, and with two stand-ins for the learner
that repeat the actions of the run. One does nothing else: what it leaves is what learning may cost.
The other runs the minimal forward and backward pass of `learning.py` at each decision. `--run`
measures a run of your own instead, from its newest checkpoint on.

    python benchmarks/training.py --out training.json
    python benchmarks/training.py --run runs/sga-sofnn-estimated-s0
"""

import dataclasses
import shutil
import tempfile
import time
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from learning import SIZES, fill, minimal
from physics import VARIANTS
from timing import arguments, median, ratio, report

from sofnn_torch import training
from sofnn_torch.maze.odometry import WHEEL_RADIUS
from sofnn_torch.maze.robot import Physics
from sofnn_torch.runs import session
from sofnn_torch.runs.session import RunOptions, Session, arithmetic
from sofnn_torch.runs.settings import Config
from sofnn_torch.runs.signals import SignalTrap

MAX_STEPS = 2_000  # of a trial
Commands = list[list[tuple[float, float]]]  # of both wheels [rad/s], trial by trial


def options_in(runs: Path) -> RunOptions:
    """Return the default options but for the pictures, whose cost is stated apart."""
    return RunOptions(runs=runs, picture_every=0, video_every=0, quiet=True)


def fresh(
    name: str, rules: int, model: mujoco.MjModel | None, trials: int, replay: bool
) -> Callable[..., Any]:
    """Return a function that begins a run in a directory."""
    config = Config(agent=name, network="sofnn")
    if not replay:
        part = dataclasses.replace(getattr(config, name), replays=0, replay_every=0)
        config = dataclasses.replace(config, **{name: part})
    net = dataclasses.replace(config.net, max_rules=rules + 5_000)
    maze = dataclasses.replace(config.maze, max_steps=MAX_STEPS)
    config = dataclasses.replace(config, trials=trials, net=net, maze=maze)

    def begin(runs: Path) -> Session:
        begun = session.begin(config, options_in(runs))
        fill(begun.agent.net, rules)
        if model is not None:
            begun.env.physics = Physics(model)
        return begun

    return begin


def continued(run: Path, trials: int) -> Callable[..., Any]:
    """Return a function that goes on with a copy of a run in a directory."""
    done = max(int(file.stem.partition("-")[2]) for file in run.glob("checkpoint-*.pt"))

    def begin(runs: Path) -> Session:
        copy = Path(shutil.copytree(run, runs / run.name))
        return session.reopen(copy, options_in(runs), trials=done + trials)

    return begin


def timed_run(begin: Callable[..., Any]) -> float:
    """Return the seconds of one run."""
    with tempfile.TemporaryDirectory() as directory:
        begun = begin(Path(directory))
        start = time.perf_counter()
        training._loop(begun, options_in(Path(directory)), SignalTrap())
        return time.perf_counter() - start


def recorded_run(begin: Callable[..., Any]) -> tuple[Commands, list[Any], Session]:
    """Return the wheel commands and actions of a run, the same in every repeat, and the run."""
    commands: Commands = []
    actions: list[Any] = []
    with tempfile.TemporaryDirectory() as directory:
        begun = begin(Path(directory))
        physics = begun.env.physics
        place, drive = physics.place, physics.drive

        def note_place(pose: Any) -> None:
            commands.append([])
            place(pose)

        def note_drive(left: float, right: float) -> None:
            commands[-1].append((left / WHEEL_RADIUS, right / WHEEL_RADIUS))
            drive(left, right)

        def noting(decide: Callable[..., Any]) -> Callable[..., Any]:
            return lambda *given: actions.append(decide(*given)) or actions[-1]

        agent = begun.agent
        agent.start, agent.step = noting(agent.start), noting(agent.step)
        physics.place, physics.drive = note_place, note_drive
        training._loop(begun, options_in(Path(directory)), SignalTrap())
        physics.place, physics.drive = place, drive
    return commands, actions, begun


def scripted(
    begin: Callable[..., Any], actions: list[Any], beside: Callable[[], Any]
) -> Callable[..., Any]:
    """Return a function that begins the same run with a stand-in for the learner.

    It repeats the given actions and does what stands beside before each.
    """

    def begin_scripted(runs: Path) -> Session:
        begun, given = begin(runs), iter(actions)

        def decide(*_: Any) -> Any:
            beside()
            return next(given)

        begun.agent.start = begun.agent.step = decide
        begun.agent.statistics = dict
        return begun

    return begin_scripted


def bare(physics: Physics, commands: Commands) -> float:
    """Return the seconds of the physics alone."""
    model, data, substeps, step = physics.model, physics.data, physics.substeps, mujoco.mj_step
    control = data.ctrl
    start = time.perf_counter()
    for trial in commands:
        physics.place(physics.plan.start)
        for left, right in trial:
            control[0] = left
            control[1] = right
            step(model, data, substeps)
    return time.perf_counter() - start


def measure(begin: Callable[..., Any], repeats: int) -> dict[str, Any]:
    """Return the times of a run and of its physics."""
    commands, actions, begun = recorded_run(begin)
    net, steps = begun.agent.net, sum(map(len, commands))
    passes = minimal(net.n_rules, net.n_outputs)
    idle, least = (scripted(begin, actions, beside) for beside in (lambda: None, passes))
    times = [
        (*map(timed_run, (begin, idle, least)), bare(begun.env.physics, commands))
        for _ in range(repeats)
    ]
    full, nothing, bound, alone = np.array(times).T / steps * 1e6
    return {
        "rules": net.n_rules,
        "steps": steps,
        "bare us/step": median(alone),
        "training us/step": median(full),
        "ratio": ratio(alone, full),
        "minimal passes": ratio(alone, bound),
        "idle learner": ratio(alone, nothing),
    }


@arithmetic()
def main() -> None:
    """Measure, print a table, and write it as JSON."""
    options = arguments(__doc__, repeats=7, run="a run directory to measure instead")
    if options.run:
        report(
            options,
            training=[
                {"run": options.run.name} | measure(continued(options.run, 5), options.repeats)
            ],
        )
        return
    reference = VARIANTS[0].build().model
    rows = []
    for physics, model, trials, share in (("ours", None, 4, 1), ("reference", reference, 2, 3)):
        for replay, rules, name in product((True, False), SIZES, ("sga", "q")):
            begin = fresh(name, rules, model, trials, replay)
            row = {"learner": name, "physics": physics, "replay": "yes" if replay else "no"}
            rows.append(row | measure(begin, max(3, options.repeats // share)))
    report(options, training=rows)


if __name__ == "__main__":
    main()
