"""Search for settings that learn better, with Optuna.

    python -m sofnn_torch.sweep --env CartPole-v1 --agent q --trials 60 --tries 40
    python -m sofnn_torch.sweep --agent q --space space.toml --seeds 0-4 --budget 100000
    python -m sofnn_torch.sweep --settings best.toml --space finer.toml --out runs/finer

Each try is a setting from the space; its seeds are trained one after the other, hopeless ones are
given up on the way, and what their greedy policies reach is what the try is worth. The best setting
is printed as flags and written to best.toml, which `train.py --settings` takes. The same command
goes on where a sweep stopped, and several processes with the same command share its tries.
"""

import contextlib
import dataclasses
import json
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import filelock
import tyro

if __name__ == "__main__":  # Ctrl-C while libraries load: there is nothing to save yet
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from sofnn_torch import terminal
from sofnn_torch.bounds import Count, Settings, Within
from sofnn_torch.progress import Progress, say
from sofnn_torch.runs import parallel, preset_files
from sofnn_torch.runs.guard import Divergence
from sofnn_torch.runs.places import default_name, directory
from sofnn_torch.runs.settings import MAZE, Config
from sofnn_torch.sweep import space, tries
from sofnn_torch.sweep.space import Range
from sofnn_torch.terminal import quoted

NEED = "sweeps need the package optuna: pip install 'sofnn-torch[sweep]'"
NAME = "sweep"


@dataclass(frozen=True)
class Options(Settings):
    """Search for settings that learn better."""

    env: str | None = None
    """Task, as for `train.py`."""
    agent: str | None = None
    """Learner, as for `train.py`."""
    network: Literal["sofnn", "fixed"] | None = None
    """Network, as for `train.py`."""
    trials: Count | None = None
    """Trials that each run learns for, as for `train.py`."""
    settings: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Start from the settings in this TOML file; those above win."""
    space: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """TOML file of what is searched for; by default the widths, rates and the like of the
    learner, around the preset."""
    tries: Count = 50
    """Settings that are tried in all."""
    seeds: str = "0-2"
    """Seeds that each setting is tried with, such as `0-2` or `0,3`."""
    objective: Literal["return", "steps"] | None = None
    """What the greedy policy is judged by: its return, or its steps (failed trials count in full);
    by default steps in the maze and return in other tasks."""
    episodes: Count = 20
    """Trials that it plays."""
    budget: Count | None = None
    """Environment steps after which a run ends, with the trial that completes them."""
    seed: Annotated[int, Within(least=0)] = 0
    """Seed of the search."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Where the sweep and its runs are; by default runs/sweep-... named by learner and task."""


@dataclass(frozen=True)
class Sweep:
    """What is searched: settings, ranges, goal, place."""

    options: Options
    entries: dict[str, Any]
    ranges: dict[str, Range]
    goal: tries.Goal
    seeds: list[int]
    trials: int
    out: Path

    def config(self, values: dict[str, Any], seed: int = 0) -> Config:
        """The settings with some values of the ranges."""
        return preset_files.make(self.entries | values | {"seed": seed})


def plan(options: Options) -> Sweep:
    """What the options ask for, checked.

    Raises:
        ValueError: one line on what is wrong.
    """
    entries = preset_files.read(options.settings) if options.settings else {}
    given = {name: getattr(options, name) for name in ("env", "agent", "network", "trials")}
    entries |= {name: value for name, value in given.items() if value is not None}
    base = preset_files.make(entries)
    asked = preset_files.read(options.space) if options.space else space.built_in(base)
    ranges = space.ranges(asked, entries, str(options.space or "the built-in space"))
    objective = options.objective or ("steps" if base.env == MAZE else "return")
    goal = tries.Goal(objective, options.episodes, options.budget)
    name = default_name(base).removesuffix(f"-s{base.seed}")
    out = options.out or Path("runs") / f"sweep-{name}"
    return Sweep(options, entries, ranges, goal, parallel.parse(options.seeds), base.trials, out)


def run(options: Options) -> int:
    """What the command does; the exit code.

    Raises:
        ValueError: options that cannot be used, or Optuna is missing.
        Interrupted: by a signal, after saving; the same command goes on.
    """
    sweep = plan(options)
    study = _open(sweep)
    units = len(sweep.seeds) * sweep.trials
    left = sum(not trial.state.is_finished() for trial in study.trials)
    left += max(0, options.tries - len(study.trials))
    with Progress("sweep", left * units, quiet=left == 0) as bar:
        while taken := _take(sweep, study):
            with taken as trial:
                _try(sweep, trial, bar)
            _write_best(sweep, study)
    _tell(sweep, study)
    return 0


def _open(sweep: Sweep) -> Any:
    """The study of Optuna, made or found again.

    Raises:
        ValueError: Optuna is missing, or the directory holds another sweep.
    """
    try:
        import optuna
        from optuna.storages.journal import JournalFileBackend
    except ModuleNotFoundError:
        raise ValueError(NEED) from None
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    asked = dataclasses.asdict(sweep.options) | {"seeds": sweep.seeds}
    for name in ("tries", "out", "space", "settings"):
        del asked[name]
    asked |= {"entries": sweep.entries, "space": {n: vars(r) for n, r in sweep.ranges.items()}}
    asked = json.loads(json.dumps(asked))
    try:
        directory(sweep.out, "--out")
        if any(sweep.out.iterdir()) and not (sweep.out / "journal.log").exists():
            raise ValueError(f"--out {sweep.out} holds something that is no sweep")
        backend = JournalFileBackend(str(sweep.out / "journal.log"))
        with _alone(sweep.out):
            study = optuna.create_study(
                study_name=NAME,
                storage=optuna.storages.JournalStorage(backend),
                pruner=optuna.pruners.MedianPruner(5, sweep.trials // 4),
                direction=sweep.goal.direction,
                load_if_exists=True,
            )
            before: dict[str, Any] = study.user_attrs.get("asked", {})
            if not before:
                study.set_user_attr("asked", asked)
    except OSError as error:
        raise ValueError(f"--out {sweep.out} cannot be used ({error.strerror})") from None
    for name in asked if before else ():
        if asked[name] != before.get(name):
            raise ValueError(
                f"{sweep.out} holds a sweep with another {name}: give another --out, or the "
                f"same (there {before.get(name)}, here {asked[name]})"[:300]
            )
    return study


def _alone(out: Path) -> filelock.BaseFileLock:
    return filelock.FileLock(out / "claim.lock")


def _take(sweep: Sweep, study: Any) -> "contextlib.AbstractContextManager[Any] | None":
    """A try that nobody works on: one that was cut short or a new one; None if none is left."""
    import optuna

    def held(number: int) -> filelock.BaseFileLock | None:
        lock = filelock.FileLock(sweep.out / f"try-{number}.lock", timeout=0)
        with contextlib.suppress(filelock.Timeout):
            lock.acquire()
            return lock
        return None

    @contextlib.contextmanager
    def working(trial: Any, lock: filelock.BaseFileLock) -> Iterator[Any]:
        try:
            yield trial
        finally:
            lock.release()

    with _alone(sweep.out):
        for old in study.get_trials(states=(optuna.trial.TrialState.RUNNING,)):
            if lock := held(old.number):
                say(f"try {old.number} was cut short: it goes on")
                return working(optuna.trial.Trial(study, old._trial_id), lock)
        if len(study.trials) >= sweep.options.tries:
            return None
        trial = study.ask()
        lock = held(trial.number)
        assert lock is not None  # the number is new
        return working(trial, lock)


def _try(sweep: Sweep, trial: Any, bar: Progress) -> None:
    """Do a try and tell Optuna what it is worth."""
    import optuna

    # Of the number, so that neither an interruption nor another process changes what is drawn.
    seed = sweep.options.seed * 1_000_003 + trial.number
    trial.study.sampler = optuna.samplers.TPESampler(seed=seed % 2**32)
    values = {n: space.fitting(n, r.suggest(trial, n)) for n, r in sweep.ranges.items()}
    shown = before = bar.done
    facts = [f"try {trial.number}", *_best(sweep, trial.study)]  # reads the whole journal
    state = optuna.trial.TrialState

    def seen(number: int) -> None:
        nonlocal shown
        done = before + first + number
        bar.update(done - shown, facts=facts)
        shown = done

    try:
        configs = [sweep.config(values, seed) for seed in sweep.seeds]
        runs = [sweep.out / f"try-{trial.number}-s{c.seed}" for c in configs]
        for i, (config, run) in enumerate(zip(configs, runs, strict=True)):
            first = i * config.trials
            tries.learn(config, run, sweep.goal, trial, first, seen)
        trial.study.tell(trial, tries.judge(runs, sweep.goal))
    except tries.Hopeless:
        trial.study.tell(trial, state=state.PRUNED)
    except Divergence as error:
        trial.set_user_attr("diverged", str(error))
        trial.study.tell(trial, state=state.PRUNED)
    except ValueError as error:  # values that do not go together
        trial.set_user_attr("failed", str(error))
        say(f"try {trial.number} failed: {error}")
        trial.study.tell(trial, state=state.FAIL)
    bar.update(before + len(sweep.seeds) * sweep.trials - shown)


def _complete(study: Any) -> list[Any]:
    """The tries that came to their end, the best first."""
    done = [trial for trial in study.trials if trial.state.name == "COMPLETE"]
    sign = 1 if study.direction.name == "MINIMIZE" else -1
    return sorted(done, key=lambda trial: (sign * trial.value, trial.number))


def _values(sweep: Sweep, trial: Any) -> dict[str, Any]:
    import optuna

    fixed = optuna.trial.FixedTrial(trial.params)
    return {n: space.fitting(n, r.suggest(fixed, n)) for n, r in sweep.ranges.items()}


def _best(sweep: Sweep, study: Any) -> list[str]:
    done = _complete(study)[:1]
    return [f"best {sweep.goal.objective} {trial.value:,.4g}" for trial in done]


def _write_best(sweep: Sweep, study: Any) -> None:
    for trial in _complete(study)[:1]:
        reached = f"{sweep.goal.objective} {trial.value:.6g}"
        about = f"try {trial.number} of a sweep: {reached} over seeds {sweep.options.seeds}"
        preset_files.write(sweep.out / "best.toml", sweep.config(_values(sweep, trial)), about)


def _tell(sweep: Sweep, study: Any) -> None:
    """Print what was found, and how to go on from it."""
    names = [trial.state.name for trial in study.trials]
    counts = {"complete": "COMPLETE", "given up": "PRUNED", "failed": "FAIL", "running": "RUNNING"}
    said = (f"{names.count(state)} {what}" for what, state in counts.items() if state in names)
    print(f"{terminal.plural(len(names), 'setting')} tried: {', '.join(said)}")
    done = _complete(study)
    if not done:
        print("none came to its end: see the runs, or give another --space")
        return
    for trial in done[:5]:
        values = preset_files.flags(_values(sweep, trial))
        print(f"  try {trial.number}: {sweep.goal.objective} {trial.value:,.6g}  {values}")
    config = sweep.config(_values(sweep, done[0]))
    print(f"best: train.py {preset_files.flags(preset_files.differences(config))}")
    print(f"written: {sweep.out / 'best.toml'}")
    print("next:")
    print(f"  {terminal.program('train')} --settings {quoted(sweep.out / 'best.toml')}")
    print(f"  {terminal.program('plot')} {quoted(sweep.out)}")
    print(f"  optuna-dashboard {quoted(sweep.out / 'journal.log')}")


def main() -> None:
    """Entry point of ``python -m sofnn_torch.sweep``."""
    terminal.command(run, Options, __doc__ or "", advice="the same command goes on")


if __name__ == "__main__":
    main()
