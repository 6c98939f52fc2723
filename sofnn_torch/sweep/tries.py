"""One try of a sweep: the runs of its seeds, stopped early where they are hopeless, then judged."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sofnn_torch import evaluate, training
from sofnn_torch.pictures.figures import read_column
from sofnn_torch.runs import checkpoint
from sofnn_torch.runs.session import arithmetic
from sofnn_torch.runs.settings import Config
from sofnn_torch.runs.trial import TrialRecord

REPORTS = 20  # looks at a run on its way
LAST = 10  # trials whose mean is looked at


@dataclass(frozen=True)
class Goal:
    """What a sweep is for.

    Attributes:
        objective: ``return``, the more the better, or ``steps``, the fewer.
        episodes: trials that the greedy policy of each seed plays after learning.
        budget: environment steps after which a run ends, with the trial that completes them.
    """

    objective: str
    episodes: int
    budget: int | None

    @property
    def direction(self) -> Literal["minimize", "maximize"]:
        """For Optuna."""
        return "minimize" if self.objective == "steps" else "maximize"

    @property
    def column(self) -> str:
        """Of trials.csv, what a run is judged by on its way."""
        return "steps" if self.objective == "steps" else "reward"

    def reached(self, steps: int) -> bool:
        """Whether so many environment steps are all that a run may take."""
        return self.budget is not None and steps >= self.budget


class Hopeless(Exception):
    """A run is not worth going on with."""


def learn(
    config: Config, run: Path, goal: Goal, trial: Any, first: int, seen: Callable[[int], None]
) -> None:
    """Train a run, or go on with it where it was cut short.

    Args:
        config: its settings.
        run: its directory.
        goal: of the sweep.
        trial: of Optuna; is told how the run does.
        first: step of this run's first trial in what Optuna is told.
        seen: called with the number of every trial that is over.

    Raises:
        Hopeless: Optuna says so.
        Divergence, Interrupted, OSError: as `training.train`.
    """
    every, hopeless = max(1, config.trials // REPORTS), False
    told = set(trial.study.trials[trial.number].intermediate_values)

    def after(record: TrialRecord) -> bool:
        nonlocal hopeless
        seen(record.trial)
        if record.trial % every == 0:
            step = first + record.trial
            if step not in told:
                recent = read_column(run / "trials.csv", goal.column)[-LAST:]
                trial.report(float(recent.mean()), step)
            hopeless = trial.should_prune()
        return hopeless or goal.reached(record.total_steps)

    options = training.RunOptions.silent(run)
    if not (run / "config.json").exists():
        training.train(config, options, after)
    else:
        hopeless = max(told, default=0) > first and trial.should_prune()
        _, state, _ = checkpoint.find_latest(run)
        done = state["trial"] >= config.trials or goal.reached(state["total_steps"])
        if not done and not hopeless:
            training.resume(run, options, after=after)
    if hopeless:
        raise Hopeless


@arithmetic()
def judge(runs: Sequence[Path], goal: Goal) -> float:
    """The mean over the runs of what their greedy policies reach."""
    values = []
    for run in runs:
        config, agent, _, _ = evaluate.load(run)
        records = evaluate.evaluate(config, agent, goal.episodes, seed=1000 + config.seed)
        values += [float(getattr(record, goal.column)) for record in records]
    return sum(values) / len(values)
