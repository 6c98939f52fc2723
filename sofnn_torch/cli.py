"""The command line of training: flags, one clear line for what is wrong, exit codes.

Exit codes: 0 done, 1 diverged or not saved where it should be, 2 bad input, 128 + n stopped by
signal n after saving (130 SIGINT, 143 SIGTERM, 129 SIGHUP, 138 SIGUSR1 on Linux).
"""

import argparse
import dataclasses
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NoReturn

import tyro

if __name__ == "__main__":  # Ctrl-C while libraries load: there is nothing to save yet
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from sofnn_torch import training
from sofnn_torch.bounds import Count, Settings
from sofnn_torch.runs import checkpoint, directory, parallel, preset_files
from sofnn_torch.runs.guard import Divergence
from sofnn_torch.runs.session import RunOptions, home_of, saved_config
from sofnn_torch.runs.settings import BASIC, Config, why_idle
from sofnn_torch.terminal import attempt, plural, program, quoted
from sofnn_torch.terminal import parse as parse_flags

EXAMPLES = """Train a robot to find its way with a self-organizing fuzzy neural network.

Examples:
  train.py                                     stochastic gradient ascent, growing network
  train.py --agent q --network fixed --pose true --seed 3 --trials 300
  train.py --resume runs/sga-sofnn-estimated-s0  go on where a run stopped
  train.py --settings best.toml --trials 300   settings from a file, one of them changed
  train.py --seeds 0-7 --workers 2             eight runs, two at a time
  train.py --seeds 0-99 --cluster tcp://host:8786  on the workers of a Dask cluster

Ctrl-C saves. Watch with: tensorboard --logdir runs
"""


@dataclass(frozen=True)
class Flags(Settings):
    """All flags of the command line."""

    config: Annotated[Config, tyro.conf.arg(name="")]
    options: Annotated[RunOptions, tyro.conf.arg(name="")]
    settings: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Start from the settings in this TOML file; the other flags change them."""
    resume: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None
    """Go on with the run in this directory, or from one of its checkpoint files. Its settings
    are kept; only `--trials` may be raised."""
    seeds: Annotated[str | None, tyro.conf.arg(metavar="LIST")] = None
    """Train several seeds, each in its own process and run: `0-7` or `0,3,5`."""
    workers: Count = 1
    """Seeds that are trained at the same time (with `--seeds`)."""
    cluster: Annotated[str | None, tyro.conf.arg(metavar="WHERE")] = None
    """Train the seeds on a Dask cluster: the address of its scheduler, as in `tcp://host:8786`, or
    `slurm` for `--workers` workers of a Slurm cluster (docs/scale.md)."""
    again: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Play the trial again that follows a saved state, such as a `divergence-12.pt`."""


MOST_USED = (  # what --help shows
    "env agent network pose preset seed trials maze.layout settings resume seeds workers cluster "
    "name quiet"
).split()
FAILURES = {ValueError: 2, Divergence: 1, OSError: 1}


def main(argv: Sequence[str] | None = None) -> int:
    """Train as the flags say; the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    return attempt(lambda: _train(words), FAILURES)


def _train(argv: list[str]) -> int:
    flags = parse(argv)
    if flags.again:
        training.play_again(flags.again)
        return 0
    if flags.seeds is not None:
        return parallel.train(
            flags.config, flags.options, flags.seeds, flags.workers, flags.cluster
        )
    if flags.resume:
        run = training.resume(flags.resume, flags.options, flags.config.trials)
    else:
        run = training.train(flags.config, flags.options)
    print(f"{run}: done")
    if not flags.options.quiet:
        print(_achieved(run))
    return 0


def _achieved(run: Path) -> str:
    """What a training reached in its last trials, and the commands to see more of it."""
    _, state, _ = checkpoint.find_latest(run)
    recent, rules = state["recent"], plural(state["network"]["rules"], "rule")
    count = plural(len(recent), "trial")
    if all(type(outcome) is bool for outcome, _ in recent):
        arrived = [steps for success, steps in recent if success]
        steps = f", {sum(arrived) / len(arrived):,.0f} steps on average" if arrived else ""
        reached = f"goal in {len(arrived)} of the last {count}{steps}"
    else:  # a task without success is judged by its return
        mean = sum(outcome for outcome, _ in recent) / len(recent)
        reached = f"return {mean:,.4g} on average of the last {count}"
    lines = [
        f"{reached}; {rules}",
        "next:",
        f"  {program('evaluate')} {quoted(run)}",
        f"  {program('rules')} {quoted(run)}",
        f"  tensorboard --logdir {quoted(run.parent)}",
    ]
    return "\n".join(lines)


def parse(argv: Sequence[str]) -> Flags:
    """The flags, on top of a preset or of the settings of the run to resume.

    Raises:
        ValueError: one line on what is wrong.
        SystemExit: with code 0 after printing the help.
    """
    first = _Parser(add_help=False, allow_abbrev=False)
    for name in BASIC:
        first.add_argument(f"--{name}", default=argparse.SUPPRESS)
    first.add_argument("--settings", type=Path)
    first.add_argument("--resume", type=Path)
    known, _ = first.parse_known_args(argv)
    if known.resume and not {"-h", "--help", "--help-all"} & set(argv):
        base = saved_config(known.resume)
    else:
        base = _preset(known)
    unchanged = Flags(config=base, options=RunOptions())
    flags = parse_flags(Flags, argv, EXAMPLES, unchanged, MOST_USED)
    if flags.resume:
        _keep_settings(flags, flags.resume, base)
    _refuse_idle(flags, unchanged)
    if flags.seeds is not None and flags.config.seed != Config.seed:
        raise ValueError("--seed and --seeds exclude each other")
    return flags


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ValueError(message)


def _preset(known: argparse.Namespace) -> Config:
    """The settings that the flags change: of a preset of the package, or of one in a file."""
    given = {name: value for name, value in vars(known).items() if name in BASIC}
    seed = str(given.pop("seed", ""))
    given |= {"seed": int(seed)} if seed.isdecimal() else {}
    if known.settings:
        return preset_files.from_file(known.settings, **given)
    try:
        return Config(**given)
    except ValueError:
        if given.get("env", Config.env) != Config.env:  # the flags below are those of another task
            raise
        return Config()  # no such preset: all flags are checked next


def _keep_settings(flags: Flags, run: Path, base: Config) -> None:
    """Refuse flags that contradict the run to resume."""
    if flags.seeds is not None or flags.again or flags.settings:
        raise ValueError("--resume goes with neither --seeds, --again nor --settings")
    moved = {"name", "runs"} & set(_changes(flags.options, RunOptions()))
    if moved and home_of(run):
        raise ValueError(f"--{min(moved)} is for new runs; a resumed run keeps its directory")
    asked = dataclasses.replace(flags.config, trials=base.trials)
    for name in _changes(asked, base):
        ours, theirs = (directory.flatten(dataclasses.asdict(c))[name] for c in (asked, base))
        ours, theirs = directory.brief(ours), directory.brief(theirs)
        raise ValueError(
            f"{_flag(name)} {ours} contradicts {run}, which has {theirs}: "
            "a run keeps its settings; only --trials may be raised"
        )


def _refuse_idle(flags: Flags, base: Flags) -> None:
    """Refuse flags that change nothing, given the others."""
    alone = Flags(Config(), RunOptions(), again=flags.again)
    if flags.again and (others := _changes(flags, alone)):
        raise ValueError(f"{_flag(others[0])} has no effect with --again")
    idle = flags.config.idle()
    if flags.seeds is None:
        idle |= dict.fromkeys(("workers", "cluster"), "without --seeds")
    elif flags.cluster not in (None, parallel.SLURM):
        idle |= {"workers": f"with --cluster {flags.cluster}, which has the workers it has"}
    for name in _changes(flags, base):
        if why := why_idle(idle, name):
            raise ValueError(f"{_flag(name)} has no effect {why}")


def _changes(ours: Any, theirs: Any) -> list[str]:
    """Names of the settings that differ."""
    a, b = (directory.flatten(dataclasses.asdict(settings)) for settings in (ours, theirs))
    changed = [name for name in a if a[name] != b[name]]
    return [name.removeprefix("config.").removeprefix("options.") for name in changed]


def _flag(name: str) -> str:
    return f"--{name}".replace("_", "-")


if __name__ == "__main__":
    sys.exit(main())
