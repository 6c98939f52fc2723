"""A run in progress: begun from settings or reopened from a checkpoint."""

import contextlib
import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch

from sofnn_torch.bounds import Count, Settings, Within
from sofnn_torch.learners.learner import Learner
from sofnn_torch.runs import checkpoint, places
from sofnn_torch.runs.checkpoint import CheckpointError
from sofnn_torch.runs.directory import Run, load_config, same_settings
from sofnn_torch.runs.factory import Environment, make_agent, make_env
from sofnn_torch.runs.provenance import make_portable
from sofnn_torch.runs.seeding import stream
from sofnn_torch.runs.settings import Config, from_dict
from sofnn_torch.runs.trial import TrialRecord
from sofnn_torch.terminal import quoted

LARGE_BLOCK = 2**25 - 2**14  # bytes; just below the largest block that glibc learns to keep
MOST_THREADS = 256  # beyond some number a system starts no more, and the process dies of it
LONGEST_NAME = 200  # bytes; file systems allow 255, and a name gets additions
WINDOW = 10  # trials that decide which checkpoint is the best


@dataclass(frozen=True)
class RunOptions(Settings):
    """How a run is kept and shown; nothing here but `threads` and `portable` changes bits.

    Examples:
        >>> RunOptions(runs="experiments", name="first", picture_every=0).name
        'first'
    """

    @classmethod
    def silent(cls, run: Path) -> "RunOptions":
        """For a run in this directory of which nothing is shown and nothing drawn."""
        return cls(runs=run.parent, name=run.name, picture_every=0, video_every=0, quiet=True)

    runs: Path = Path("runs")
    """Directory of all runs."""
    name: str | None = None
    """Name of the run's directory; by default made from agent, network, pose and seed."""
    checkpoint_every: Count = 5
    """Trials from one checkpoint to the next."""
    keep: Count = 3
    """Checkpoints that are kept, beside the best one."""
    picture_every: Annotated[int, Within(least=0)] = 25
    """Trials from one set of TensorBoard pictures to the next; 0 for none."""
    video_every: Annotated[int, Within(least=0)] = 50
    """Trials from one TensorBoard video to the next; 0 for none."""
    threads: Annotated[Count, Within(most=MOST_THREADS)] = 1
    """Threads of torch; one is fastest at this size. Results with replay or with several thousand
    rules differ in their last bits between one and more."""
    portable: bool = False
    """Compute the same bits on every x86-64 processor with AVX2, whatever else it has. Not the bits
    of runs without this; the speed is about the same."""
    quiet: bool = False
    """No progress bar."""

    def __post_init__(self) -> None:
        """Check the numbers; ValueError names the flag."""
        super().__post_init__()
        name = self.name
        if name is None:
            return
        if (
            not name.strip(". ")
            or name.startswith("-")
            or Path(name).name != name
            or not name.isprintable()
        ):
            raise ValueError(f"--name must be a plain directory name, got {name!r}")
        if len(name.encode()) > LONGEST_NAME:
            raise ValueError(f"--name must have at most {LONGEST_NAME} bytes, got {name[:40]}...")


@dataclass
class Session:
    """Directory, learner and maze of a run, and its state after the last whole trial."""

    run: Run
    agent: Learner
    env: Environment
    state: dict[str, Any]

    @property
    def trial(self) -> int:
        """Trials done."""
        return self.state["trial"]

    def advance(self, record: TrialRecord) -> bool:
        """Take over the state after a trial; True if the last ten trials are the best so far."""
        recent = [*self.state["recent"], [record.outcome, record.steps]][-WINDOW:]
        best = former = self.state["best"]
        if len(recent) == WINDOW:  # more successes or return, then fewer steps
            best = max(best, [sum(s for s, _ in recent), -sum(n for _, n in recent)])
        counters = {"trial": record.trial, "total_steps": record.total_steps}
        window = {"recent": recent, "best": best}
        self.state = self.state | counters | window | checkpoint.snapshot(self.agent, self.env)
        return best != former

    def save(self) -> bool:
        """Write a checkpoint; True if it is on the disk."""
        return self.run.save(self.state)

    def close(self) -> None:
        """Save the last whole trial if it is not saved, if need be outside the run directory.

        Raises:
            OSError: it could not be saved in its place; the message says where it is.
        """
        try:
            if self.run.saved != self.trial and not self.save():
                place = self.run.rescue(self.state)
                raise OSError(
                    f"{self.run.path} cannot be written; trial {self.trial} is saved outside it: "
                    f"go on with --resume {quoted(place)}"
                )
        finally:
            self.run.close()
            self.env.close()


@contextlib.contextmanager
def arithmetic(threads: int = 1, portable: bool = False) -> Iterator[None]:
    """Set torch's number of threads; inside, results below 1e-38 count as 0. Also a decorator.

    Firing strengths and traces far from the state are full of such denormal numbers, for which
    processors take many times as long. Nor does memory go back to the system after each batch: new
    pages cost as much as the arithmetic on them.

    Args:
        threads: of torch.
        portable: compute the same bits on every processor with AVX2, until the process ends.

    Raises:
        ValueError: the processor has no AVX2, or torch has computed something already.
    """
    if portable:
        make_portable()
    for kind in (np.float32, np.float64):
        np.finfo(kind)  # remembered; NumPy before 2.4 would warn that it finds no denormal numbers
    flushed, former = bool(torch.tensor(1e-30) * 1e-10 == 0), torch.get_num_threads()
    torch.set_flush_denormal(True)  # first: threads inherit it when they are made
    torch.set_num_threads(threads)
    torch.empty(LARGE_BLOCK, dtype=torch.uint8)  # freed at once; glibc keeps blocks of its size
    try:
        yield
    finally:
        torch.set_flush_denormal(flushed)
        torch.set_num_threads(former)


def begin(config: Config, options: RunOptions) -> Session:
    """A new run, its settings and its state before the first trial on the disk.

    Raises:
        ValueError: settings or run directory cannot be used; nothing was written then.
    """
    agent, env = build(config)
    state = _first_state(config, agent, env)
    run = _create(config, options, state)
    return Session(run, agent, env, state)


def reopen(path: Path, options: RunOptions, trials: int | None = None) -> Session:
    """A run as it was after its last checkpoint; its directory is only changed if trials remain.

    Args:
        path: a run directory, or one checkpoint file to go back to. A file outside a run
            directory goes on in a new one.
        options: how the run is kept.
        trials: new total of trials; None for the one of the run.

    Raises:
        CheckpointError: no checkpoint fits; the message names the last good one, if any.
        ValueError: settings or run directory cannot be used.
    """
    with contextlib.ExitStack() as undo:
        config, run, file = saved_config(path), None, path
        if home := home_of(path):
            run = Run.open(home, config, options.keep)
            undo.callback(run.close)
            file, state = _choose(home, path, config)
        else:
            state = checkpoint.load(path)
        if trials is not None:
            config = dataclasses.replace(config, trials=trials)
        agent, env = build(config)
        if state is None:
            state = _first_state(config, agent, env)
        else:
            checkpoint.restore(file, state, agent, env)
        state["config"], done = dataclasses.asdict(config), state["trial"]
        if done > config.trials:
            raise ValueError(f"{path} has {done} trials already: give --trials {done} or more")
        if run is None:
            run = _create(config, options, state)
        elif done < config.trials:
            run.config = config
            run.rewind(state)
        else:
            run.saved = done
        undo.pop_all()
        return Session(run, agent, env, state)


def _create(config: Config, options: RunOptions, state: dict[str, Any]) -> Run:
    """A new run with its first checkpoint."""
    usual = places.numbered(options.runs / places.default_name(config))
    free = usual if options.name is None else [options.runs / options.name]
    with Run.create(free, config, options.keep) as run:
        run.begin(state)
    return run


def build(config: Config) -> tuple[Learner, Environment]:
    """Learner and environment with their own random numbers.

    Raises:
        ValueError: settings that do not go together.
    """
    agent, env = make_agent(config), make_env(config)
    env.reset(seed=stream("training", config.seed))
    return agent, env


def saved_config(path: Path) -> Config:
    """The settings of a run directory or of a checkpoint file.

    Raises:
        ValueError: there are none, or this version does not know them.
    """
    if home := home_of(path):
        return load_config(home)
    return from_dict(checkpoint.load(path)["config"])


def home_of(path: Path) -> Path | None:
    """The run directory that a path is or lies in; None for a lone checkpoint file."""
    if not path.is_file():
        return path
    return path.parent if (path.parent / "config.json").exists() else None


def _choose(home: Path, path: Path, config: Config) -> tuple[Path, dict[str, Any] | None]:
    """The checkpoint to go on from and its state; None if no trial was ever finished."""

    def check(file: Path, state: dict[str, Any]) -> None:
        same_settings(file, state, config)
        checkpoint.restore(file, state, *build(config))

    if path != home:
        state = checkpoint.load(path)
        check(path, state)
        return path, state
    if not checkpoint.checkpoints(home) and not (home / "trials.csv").exists():
        return path, None
    file, state, problems = checkpoint.find_latest(home, check)
    if problems:
        raise CheckpointError(
            f"{problems[0]}. To go on from the last good one: --resume {quoted(file)}"
        )
    return file, state


def _first_state(config: Config, agent: Learner, env: Environment) -> dict[str, Any]:
    counters = {"trial": 0, "total_steps": 0, "recent": [], "best": []}
    return {"config": dataclasses.asdict(config)} | counters | checkpoint.snapshot(agent, env)
