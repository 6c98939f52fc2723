"""Play a learned policy and say how good it is.

    python -m sofnn_torch.evaluate RUN                              # 10 trials, a table
    python -m sofnn_torch.evaluate RUN --episodes 100 --json result.json
    python -m sofnn_torch.evaluate RUN --video run.mp4 --viewer

By default the robot takes the mean action (SGA) or the greedy one (Q-learning); with --explore it
samples its learned stochastic policy. A policy that has come to no new state for 15 decisions gains
chance at the rules where it is, so that it leaves circles; --plain plays without that. Nothing is
learned and the run directory is not changed.
"""

import dataclasses
import json
import math
import signal
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

if __name__ == "__main__":  # Ctrl-C while libraries load
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import gymnasium
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from scipy import stats

from sofnn_torch.bounds import Count, Settings, Within
from sofnn_torch.learners.learner import Learner
from sofnn_torch.maze.optimum import mean_optimum
from sofnn_torch.maze.rendering import has_display
from sofnn_torch.pictures.film import film, gif, mp4
from sofnn_torch.progress import Progress
from sofnn_torch.runs import checkpoint, seeding
from sofnn_torch.runs.directory import same_settings
from sofnn_torch.runs.factory import make_agent, make_env, make_plan
from sofnn_torch.runs.provenance import versions
from sofnn_torch.runs.session import arithmetic, saved_config
from sofnn_torch.runs.settings import MAZE, Config
from sofnn_torch.runs.trial import TrialRecord
from sofnn_torch.terminal import check_output, command, plural, say
from sofnn_torch.training import play

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Options(Settings):
    """Play the learned policy of a run and print steps, success, collisions and pose error."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Directory of the run, or one of its checkpoint files."""
    episodes: Count = 10
    """Trials to play."""
    explore: bool = False
    """Sample the learned stochastic policy instead of its mean or greedy action."""
    plain: bool = False
    """Leave the policy as it is also where it runs in a circle."""
    best: bool = False
    """Take the checkpoint with the best last 10 trials instead of the latest."""
    seed: Annotated[int, Within(least=0)] = 1000
    """Seed of the motor noise and of the sampled actions."""
    video: Path | None = None
    """Write a video of the first trial to this .mp4 or .gif file."""
    viewer: bool = False
    """Watch in a window."""
    json: Path | None = None
    """Write the results to this file."""


@dataclass(frozen=True)
class Estimate:
    """A mean or a proportion with its 95 % confidence interval (NaN where there is none)."""

    value: float
    low: float
    high: float


def check(options: Options) -> None:
    """Check what can be checked before anything is loaded.

    Raises:
        ValueError: naming the flag.
    """
    check_output("--video", options.video, (".mp4", ".gif"))
    check_output("--json", options.json)
    if options.viewer and not has_display():
        raise ValueError("--viewer needs a display: without one use --video FILE")


class Loaded(NamedTuple):
    """What `load` found of a run: its settings, the learner, and the checkpoint and its state."""

    config: Config
    agent: Learner
    file: Path
    state: dict[str, Any]


def load(run: Path | str, best: bool = False) -> Loaded:
    """Settings, learner, file and state of the latest good checkpoint of a run, or of its best.

    Args:
        run: a run directory, or one checkpoint file.
        best: take the best checkpoint of the directory.

    Raises:
        ValueError: neither of them, or no checkpoint that fits its settings.
    """
    run = Path(run)
    config = saved_config(run)
    if best and run.is_file():
        raise ValueError(f"--best chooses a checkpoint of a run directory, and {run} is a file")
    if best or run.is_file():
        path = run / "best.pt" if best else run
        state = checkpoint.load(path)
    else:
        path, state, problems = checkpoint.find_latest(run)
        for problem in problems:
            say(f"warning: {problem}; {path.name} is used instead")
    same_settings(path, state, config)
    agent, env = make_agent(config), make_env(config)
    checkpoint.restore(path, state, agent, env)
    env.close()
    if agent.net.n_rules == 0:
        raise ValueError(f"{path}: no rule has been learned yet; train for a trial at least")
    return Loaded(config, agent, path, state)


def learned(agent: Learner, path: Path, state: dict[str, Any]) -> str:
    """For the terminal: what was loaded, in numbers."""
    trials, rules = plural(state["trial"], "trial"), plural(agent.net.n_rules, "rule")
    return f"{path}: {trials} learned, {rules}"


def evaluate(
    config: Config,
    agent: Learner,
    episodes: Count = 10,
    explore: bool = False,
    seed: Annotated[int, Within(least=0)] = 1000,
    render_mode: str | None = None,
    quiet: bool = True,
    plain: bool = False,
) -> list[TrialRecord]:
    """Play trials without learning.

    Args:
        config: settings of the run.
        agent: the learner; only its random generator changes, which begins anew from the seed.
        episodes: number of trials.
        explore: sample the stochastic policy.
        seed: seed of the motor noise and of the policy's chance.
        render_mode: ``human`` shows the trials in a window.
        quiet: show no progress.
        plain: without the cure for loops.
    """
    env = make_env(config, render_mode=render_mode)
    try:
        return played(env, agent, episodes, explore, seed, quiet, plain)
    finally:
        env.close()


def played(
    env: gymnasium.Env[Any, Any],
    agent: Learner,
    episodes: int,
    explore: bool,
    seed: int,
    quiet: bool,
    plain: bool = False,
) -> list[TrialRecord]:
    """Play trials without learning in an environment; arguments as in `evaluate`."""
    seeding.begin(env, agent, seed)
    records: list[TrialRecord] = []
    with Progress("evaluation", episodes, quiet=quiet) as progress:

        def seen(steps: int) -> None:
            progress.within(f"trial {len(records) + 1}: {steps:,} steps")

        for trial in range(1, episodes + 1):
            record, _ = play(env, agent, learn=False, explore=explore, plain=plain, seen=seen)
            records.append(dataclasses.replace(record, trial=trial))
            mean = sum(r.outcome for r in records) / trial
            said = f"return {mean:,.4g}" if record.success is None else f"goal in {mean:.0%}"
            progress.update(facts=[said, f"{record.steps} steps"])
    return records


def mean(values: Sequence[float], seed: int = 0) -> Estimate:
    """Mean with its bias-corrected bootstrap interval."""
    data = np.asarray(values, float)
    if len(data) == 0:
        return Estimate(math.nan, math.nan, math.nan)
    value = float(data.mean())
    if len(data) == 1:
        return Estimate(value, math.nan, math.nan)
    if np.ptp(data) == 0:
        return Estimate(value, value, value)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # SciPy warns where it falls short of a BCa interval
        interval = stats.bootstrap(
            (data,), np.mean, confidence_level=CONFIDENCE, rng=np.random.default_rng(seed)
        ).confidence_interval
    return Estimate(value, float(interval.low), float(interval.high))


def proportion(successes: int, trials: int) -> Estimate:
    """Share of successes with its exact interval."""
    return Estimate(successes / trials, *exact_interval(successes, trials, CONFIDENCE))


def exact_interval(successes: float, count: float, level: float) -> tuple[float, float]:
    """Interval of a share at a level of confidence (Clopper and Pearson 1934).

    Numbers may be fractions, as of trials that tell less than as many independent ones.
    """
    tail, failures = 0.5 - 0.5 * level, count - successes
    low = stats.beta.ppf(tail, successes, failures + 1.0) if successes else 0.0
    high = stats.beta.ppf(1.0 - tail, successes + 1.0, failures) if failures else 1.0
    return float(low), float(high)


def summarise(records: Sequence[TrialRecord], optimum: float | None = None) -> dict[str, Estimate]:
    """The table's rows.

    Args:
        records: the trials.
        optimum: steps of the best noise-free run through the maze, if known.
    """
    measured = [r.measures for r in records]
    rows = {name: mean([m[name] for m in measured]) for name in measured[0] if name in PRINTED}
    rows |= {"return": mean([r.reward for r in records]), "steps": mean([r.steps for r in records])}
    if records[0].success is None:
        return rows
    arrived = [r.steps for r in records if r.success]
    rows |= {"success": proportion(len(arrived), len(records)), "steps_to_goal": mean(arrived)}
    if optimum:
        scaled = (value / optimum for value in dataclasses.astuple(rows["steps_to_goal"]))
        rows["steps_over_optimum"] = Estimate(*scaled)
    return rows


NONE = Estimate(math.nan, math.nan, math.nan)

# Name in the results -> text, factor to the printed unit, decimals.
PRINTED: dict[str, tuple[str, float, int]] = {
    "success": ("trials that reached the goal, %", 100, 1),
    "return": ("return", 1, 2),
    "steps_to_goal": ("steps to the goal", 1, 1),
    "steps_over_optimum": ("  over the kinematic optimum", 1, 3),
    "steps": ("steps of all trials", 1, 1),
    "collisions": ("collisions per trial", 1, 2),
    "pose_error": ("position error, mean, mm", 1000, 2),
    "pose_error_max": ("position error, largest, mm", 1000, 2),
    "heading_error": ("heading error, mean, degrees", 180 / math.pi, 2),
}


def table(rows: dict[str, Estimate]) -> Table:
    """The results for the terminal."""
    view = Table("", "mean", "95 % interval")
    for column in view.columns[1:]:
        column.justify = "right"
    for name, (text, factor, digits) in PRINTED.items():
        if name not in rows or (name == "steps" and rows.get("success", NONE).value == 1):
            continue
        value, low, high = (f"{factor * v:.{digits}f}" for v in dataclasses.astuple(rows[name]))
        interval = "-" if "nan" in (low, high) else f"{low} .. {high}"
        view.add_row(text, value.replace("nan", "-"), interval)
    return view


def as_json(row: Estimate) -> dict[str, float | None]:
    """An estimate for JSON, which knows no NaN."""
    return {k: None if math.isnan(v) else v for k, v in dataclasses.asdict(row).items()}


def loops(records: Sequence[TrialRecord]) -> str:
    """In how many trials the cure for loops acted."""
    helped = sum(bool(record.freed) for record in records)
    return f"the way out of loops was used in {helped} of {plural(len(records), 'trial')}"


def write_video(
    path: Path,
    config: Config,
    agent: Learner,
    seed: int,
    explore: bool,
    plain: bool = False,
    steps: int = 0,
) -> None:
    """Film the first trial that `evaluate` plays with the same seed, 30 times as fast as it is.

    Args:
        path: of the film, .gif or .mp4.
        config: settings of the run.
        agent: the learner; only its random generator moves, and is set back.
        seed: as for `evaluate`.
        explore: sample the stochastic policy.
        plain: without the cure for loops.
        steps: of that trial, for the progress; 0 shows none.

    Raises:
        OSError: the film cannot be made or written.
    """
    gifs, each = path.suffix.lower() == ".gif", 1
    size: dict[str, int] = {}
    if config.env == MAZE:
        each, pixels = (5, 360) if gifs else (2, 480)
        size = {"steps_per_frame": each, "size": pixels}
    total = 1 + math.ceil(steps / each)
    with Progress("film", total, quiet=not steps) as progress:
        frames = film(config, agent, seed=seed, explore=explore, plain=plain, **size)
        shown = progress.through(frames)
        checkpoint.write_atomically(path, gif(shown) if gifs else mp4(shown))


def optimum(config: Config) -> float | None:
    """Steps of the best noise-free run through the maze, in the mean; None for other tasks."""
    if config.env != MAZE:
        return None
    return mean_optimum(make_plan(config), config.maze.hold)


@arithmetic()
def run(options: Options) -> dict[str, Estimate]:
    """What the command does.

    Raises:
        ValueError: the run cannot be used or a file cannot be written.
    """
    check(options)
    config, agent, path, state = load(options.run, options.best)
    policy = "sampled" if options.explore else agent.greedy
    records = evaluate(
        config,
        agent,
        options.episodes,
        options.explore,
        options.seed,
        "human" if options.viewer else None,
        quiet=False,
        plain=options.plain,
    )
    rows = summarise(records, optimum(config))
    print(learned(agent, path, state))
    print(f"{plural(options.episodes, 'trial')} with {policy} actions:")
    Console().print(table(rows))
    if math.isfinite(agent.task.patience) and not options.plain:
        print(loops(records))
    if options.json:
        results = {
            "checkpoint": str(path),
            "trials_learned": state["trial"],
            "rules": agent.net.n_rules,
            "policy": policy,
            "plain": options.plain,
            "seed": options.seed,
            "confidence": CONFIDENCE,
            "results": {name: as_json(row) for name, row in rows.items()},
            "trials": [record.row() for record in records],
            "config": dataclasses.asdict(config),
            "versions": versions(),
        }
        data = json.dumps(results, indent=2) + "\n"
        checkpoint.write_atomically(options.json, data.encode())
        print(f"written: {options.json}")
    if options.video:
        how = options.seed, options.explore, options.plain
        write_video(options.video, config, agent, *how, records[0].steps)
        print(f"written: {options.video}")
    return rows


def main() -> None:
    """Entry point of ``python -m sofnn_torch.evaluate``."""
    command(run, Options, __doc__)


if __name__ == "__main__":
    main()
