"""Types and ranges of settings, told in one line that names the flag."""

import dataclasses
import math
import types
import typing
from typing import Any, Literal

POSITIVE = {"hold", "max_steps", "width_position", "width_heading", "width_action", "max_rules"}
POSITIVE |= {"grid", "grid_action", "segments", "temperature", "sigma_initial", "sigma_min"}
POSITIVE |= {"sigma_max", "mean_limit", "wheel_radius_scale", "wheel_base_scale", "trials"}
POSITIVE |= {"trace_limit", "memory"}
UNIT = {"gamma", "trace_decay"}  # in [0, 1]
INTEGER = 2**63  # no whole number reaches it, so that every array and file can hold it
NOT_NEGATIVE = {"seed", "replays"}
MOST = {"hold": 10_000, "segments": 1_000, "max_rules": 10_000_000, "memory": 10_000_000}
# Bounds of mu and sigma would hide a rate that makes a typical step longer than their range.
MOST |= {"rate_mean": 500, "rate_deviation": 500}


def check(config: Any, prefix: str = "") -> None:
    """Check the numbers of a settings object and of those inside it.

    Raises:
        ValueError: one line that names the flag, the value and what is allowed.
    """
    for entry in dataclasses.fields(config):
        name, value = entry.name, getattr(config, entry.name)
        flag = f"--{prefix}{name}".replace("_", "-")
        if dataclasses.is_dataclass(value):
            check(value, f"{name}.")
            continue
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, bool) or not isinstance(number, int | float):
                continue
            if isinstance(number, int) and not abs(number) < INTEGER:
                raise ValueError(f"{flag} must lie between -2**63 and 2**63, got {number}")
            if not abs(number) < 1e300:
                raise ValueError(f"{flag} must be a finite number, got {number}")
            if number > MOST.get(name, math.inf):
                raise ValueError(f"{flag} must be at most {MOST[name]}, got {number}")
            if name in POSITIVE and number <= 0:
                raise ValueError(f"{flag} must be positive, got {number}")
            if (name in NOT_NEGATIVE or name.startswith("rate_")) and number < 0:
                raise ValueError(f"{flag} must not be negative, got {number}")
            if name in UNIT and not 0 <= number <= 1:
                raise ValueError(f"{flag} must lie in [0, 1], got {number}")
            if name == "theta" and not 0 < number < 1:
                raise ValueError(f"{flag} must lie between 0 and 1, got {number}")
            if name == "motor_noise" and not 0 <= number < 1:
                raise ValueError(f"{flag} must lie in [0, 1), got {number}")


def read(data: Any, kind: Any, where: str = "") -> Any:
    """An object of a settings class from plain data; entries that are not given take their default.

    Raises:
        ValueError: one line on an unknown entry, a wrong type or a value out of range.
    """
    if not isinstance(data, dict):
        raise ValueError(f"{where or 'the settings'}: a table of names and values is needed")
    hints = typing.get_type_hints(kind)
    if unknown := sorted(str(name) for name in data.keys() - hints.keys()):
        raise ValueError(f"{where + unknown[0][:60]!r} is not a setting of this version")
    return kind(**{name: _typed(data[name], hints[name], f"{where}{name}") for name in data})


def _typed(value: Any, hint: Any, name: str) -> Any:
    """The value of one setting if it has the annotated type."""
    if dataclasses.is_dataclass(hint):
        return read(value, hint, f"{name}.")
    choices, kind = typing.get_args(hint), typing.get_origin(hint)
    if kind is tuple and isinstance(value, list | tuple) and len(value) == len(choices):
        return tuple(_typed(v, h, name) for v, h in zip(value, choices, strict=True))
    if kind is Literal and isinstance(value, str) and value in choices:
        return value
    if kind is types.UnionType:
        return None if value is None else _typed(value, choices[0], name)
    if hint is float and type(value) in (int, float) and abs(value) < 1e300:
        return float(value)
    if (
        hint in (int, bool, str)
        and type(value) is hint
        and (hint is not int or abs(value) < INTEGER)
    ):
        return value
    wanted = " or ".join(map(str, choices)) if kind is Literal else getattr(hint, "__name__", hint)
    raise ValueError(f"{name} must be {wanted}, got {str(value)[:60]!r}")
