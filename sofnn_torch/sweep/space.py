"""The settings among which a sweep searches.

A TOML file like those for ``train.py --settings``, with a range or a list in the place of a value:

    [q]
    temperature = { low = 0.0005, high = 0.05, log = true }   # any number between; log: in factors
    replays = { low = 0, high = 100, step = 20 }              # whole numbers
    trace-decay = [0.0, 0.5, 0.8, 0.9]                        # one of these
    [net]
    width = { times = [0.3, 3.0] }                            # factors of what is set without
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sofnn_torch.runs import preset_files
from sofnn_torch.runs.directory import flatten
from sofnn_torch.runs.settings import MAZE, Config, why_idle

FORMS = "a list of choices, { low = , high = }, perhaps with step or log, or { times = [ , ] }"
DIGITS = 3  # of a number that is tried, so that flags give it exactly

SGA = {
    "sga.rate_mean": {"times": [0.1, 5.0]},
    "sga.rate_deviation": {"times": [0.1, 5.0]},
    "sga.rate_value": {"times": [0.2, 1.3]},
    "sga.trace_decay": {"low": 0.5, "high": 0.95},
    "sga.sigma_min": {"low": 0.05, "high": 0.3},
}
Q = {
    "q.temperature": {"times": [0.1, 10.0]},
    "q.rate_action": {"low": 0.1, "high": 1.0, "log": True},
    "q.trace_decay": {"low": 0.5, "high": 0.95},
}
GROWING = {"net.theta": {"low": 0.2, "high": 0.6}}
REPLAYS = {"low": 0, "high": 100, "step": 20}


@dataclass(frozen=True)
class Range:
    """What one setting may be: one of the choices, or a number from low to high."""

    choices: tuple[Any, ...] = ()
    low: float = 0
    high: float = 0
    step: float | None = None
    log: bool = False

    def ends(self) -> tuple[Any, ...]:
        """The values that must be possible for all to be."""
        return self.choices or (self.low, self.high)

    def suggest(self, trial: Any, name: str) -> Any:
        """The value that an Optuna trial takes."""
        if self.choices:
            return self.choices[trial.suggest_categorical(name, range(len(self.choices)))]
        if isinstance(self.low, int):
            return trial.suggest_int(name, self.low, self.high, step=int(self.step or 1))
        value = trial.suggest_float(name, self.low, self.high, step=self.step, log=self.log)
        return min(max(float(f"{value:.{DIGITS}g}"), self.low), self.high)


def built_in(base: Config) -> dict[str, Any]:
    """The space for a learner of this package, as it stands in a file.

    Raises:
        ValueError: there is none for a learner of one's own.
    """
    table = base.learner.Settings.table
    if table not in ("sga", "q"):
        raise ValueError(f"--space is needed: none is built in for --agent {base.agent}")
    names = ("width_position", "width_heading") if base.env == MAZE else ("width",)
    widths: dict[str, Any] = {f"net.{name}": {"times": [0.5, 2.0]} for name in names}
    space = widths | (SGA if table == "sga" else Q) | {f"{table}.replays": REPLAYS}
    return space if base.network == "fixed" else GROWING | space


def ranges(given: Mapping[str, Any], entries: Mapping[str, Any], where: str) -> dict[str, Range]:
    """The ranges of a space, checked: every end of each alone makes settings.

    Args:
        given: the space by dotted names, as `preset_files.read` reads it from a file.
        entries: the settings that are not searched for.
        where: the file, for messages.

    Raises:
        ValueError: one line on the first that is not right.
    """
    base = preset_files.make(entries)
    usual, idle, found = flatten(dataclasses.asdict(base)), base.idle(), {}
    if not given:
        raise ValueError(f"{where}: no setting to search for")
    for name, value in given.items():
        try:
            found[name] = range_ = _range(value, usual[name])
            if why := why_idle(idle, name):
                raise ValueError(f"it has no effect {why}")
            for end in range_.ends():
                preset_files.make({**entries, name: fitting(name, end)})
        except (ValueError, TypeError) as error:
            raise ValueError(f"{where}: {name}: {error}") from None
    return found


def fitting(name: str, value: Any) -> Any:
    """A value as the setting takes it: one number for all inputs is a list of one."""
    several = isinstance(preset_files.KNOWN[name], list) and not isinstance(value, list)
    return [value] if several else value


def _range(value: Any, usual: Any) -> Range:
    if isinstance(value, list) and value:
        return Range(choices=tuple(None if v == "None" else v for v in value))
    if not isinstance(value, dict):
        raise ValueError(f"needs {FORMS}, got {value!r}")
    if value.keys() == {"times"}:
        usual = usual[0] if isinstance(usual, list) else usual
        low, high = (float(f"{usual * float(t):.{DIGITS}g}") for t in value["times"])
        value = {"low": low, "high": high, "log": True}
    if not {"low", "high"} <= value.keys() <= {"low", "high", "log", "step"}:
        raise ValueError(f"needs {FORMS}")
    if not all(isinstance(value[end], int | float) for end in ("low", "high")):
        raise ValueError("low and high must be numbers")
    kind = int if type(value["low"]) is type(value["high"]) is int else float
    if isinstance(usual, float):
        kind = float
    low, high = kind(value["low"]), kind(value["high"])
    log, step = value.get("log", False) is True, value.get("step")
    if not low < high or (log and low <= 0):
        raise ValueError("low must be below high" + ", and above 0 with log" * log)
    if step is not None and (log or not isinstance(step, int | float) or step <= 0):
        raise ValueError("step must be a positive number, without log")
    return Range(low=low, high=high, step=step and kind(step), log=log)
