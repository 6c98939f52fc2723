"""Settings that are checked when they are made: types and bounds stand at each field.

    >>> @dataclass(frozen=True)
    ... class Motor(Settings, table="motor"):
    ...     gain: Annotated[float, Within(above=0, most=10)] = 1.0
    >>> Motor(gain=11)
    Traceback (most recent call last):
    ValueError: --motor.gain must lie in (0, 10], got 11.0

NumPy's scalars become Python's, so that what is written of settings can be read again.
"""

import dataclasses
import types
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

INTEGER = 2**63  # no whole number reaches it, so that every array and file can hold it
FINITE = 1e300
KINDS: dict[type, type | tuple[type, ...]] = {
    bool: np.bool_,
    int: np.integer,
    float: (int, np.integer, np.floating),
    str: Path,
}
NAMES = {bool: "True or False", int: "a whole number", float: "a number", str: "text"}


@dataclass(frozen=True)
class Within:
    """Bounds of a number, each None if there is none; at most one on either side.

    Args:
        least: the least value that is allowed.
        above: a bound that must be exceeded.
        most: the greatest value that is allowed.
        below: a bound that must not be reached.
    """

    least: float | None = None
    above: float | None = None
    most: float | None = None
    below: float | None = None

    def allows(self, number: float) -> bool:
        """Whether a number lies within the bounds; a NaN lies within none."""
        return (
            (self.least is None or number >= self.least)
            and (self.above is None or number > self.above)
            and (self.most is None or number <= self.most)
            and (self.below is None or number < self.below)
        )

    def __str__(self) -> str:
        low = self.above if self.least is None else self.least
        high = self.below if self.most is None else self.most
        if low is None:
            return f"be {'below' if self.most is None else 'at most'} {high:.15g}"
        if high is None and low == 0:
            return "be positive" if self.least is None else "not be negative"
        if high is None:
            return f"be {'above' if self.least is None else 'at least'} {low:.15g}"
        if self.least is None and self.most is None:
            return f"lie between {low:.15g} and {high:.15g}"
        ends = "(" if self.least is None else "[", ")" if self.most is None else "]"
        return f"lie in {ends[0]}{low:.15g}, {high:.15g}{ends[1]}"


Positive = Annotated[float, Within(above=0)]
NotNegative = Annotated[float, Within(least=0)]
Share = Annotated[float, Within(least=0, most=1)]
Count = Annotated[int, Within(least=1)]


class Settings:
    """Base of frozen dataclasses whose fields are checked by their annotations.

    Args:
        table: name before that of each field in messages, as in ``--sga.gamma``.
    """

    table: ClassVar[str] = ""

    def __init_subclass__(cls, table: str = "", **arguments: Any) -> None:
        """Keep the name of the table."""
        super().__init_subclass__(**arguments)
        cls.table = table

    def __post_init__(self) -> None:
        """Check every field; ValueError names the flag and what is allowed."""
        hints = typing.get_type_hints(type(self), include_extras=True)
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            checked = _checked(value, hints[field.name], flag(self.table, field.name))
            if checked is not value:
                object.__setattr__(self, field.name, checked)  # the dataclass is frozen

    @classmethod
    def upgraded(cls, data: dict[str, Any]) -> dict[str, Any]:
        """Plain data of an older version as this one writes it."""
        return data

    def idle(self) -> dict[str, str]:
        """Fields that change nothing beside the others, and why."""
        return {}


def flag(table: str, name: str) -> str:
    """The flag of a setting, as in ``--net.width-heading``."""
    return f"--{table}{'.' * bool(table)}{name}".replace("_", "-")


def read(data: Any, kind: Any, where: str = "") -> Any:
    """An object of a settings class from plain data; entries that are not given take their default.

    Raises:
        ValueError: one line on an unknown entry, a wrong type or a value out of range.
    """
    if not isinstance(data, dict):
        raise ValueError(f"{where or 'the settings'}: a table of names and values is needed")
    data, hints = kind.upgraded(data), typing.get_type_hints(kind)
    known = {field.name for field in dataclasses.fields(kind)}
    if unknown := sorted(str(name) for name in data.keys() - known):
        raise ValueError(
            f"{where + unknown[0][:60]!r} is not a setting of this version; read "
            "older files with the version of sofnn-torch that wrote them"
        )
    tables = {name for name in data if dataclasses.is_dataclass(hints[name])}
    parts = {name: read(data[name], hints[name], f"{where}{name}.") for name in tables}
    return kind(**data | parts)


def _checked(value: Any, hint: Any, name: str) -> Any:
    """The value of a setting if it is of the annotated type and within its bounds."""
    if typing.get_origin(hint) is Annotated:
        hint, *extras = typing.get_args(hint)
        value = _checked(value, hint, name)
        for bound in (extra for extra in extras if isinstance(extra, Within)):
            for number in value if isinstance(value, tuple) else (value,):
                if number is not None and not bound.allows(number):
                    raise ValueError(f"{name} must {bound}, got {number}")
        return value
    choices, kind = typing.get_args(hint), typing.get_origin(hint)
    if kind in (types.UnionType, typing.Union):  # of a type and None
        return None if value is None else _checked(value, choices[0], name)
    if kind is tuple:
        return _tuple(value, choices, name)
    if kind is Literal:
        if isinstance(value, str) and value in choices:
            return str(value)
        raise ValueError(f"{name} must be {' or '.join(map(str, choices))}, got {_show(value)}")
    return _plain(value, hint, name)


def _tuple(value: Any, choices: tuple[Any, ...], name: str) -> tuple[Any, ...]:
    value = value.tolist() if isinstance(value, np.ndarray) else value
    if not isinstance(value, list | tuple):
        raise ValueError(f"{name} must be a list of values, got {_show(value)}")
    if choices[-1] is Ellipsis:
        choices = (choices[0],) * len(value)
    if len(value) != len(choices):
        raise ValueError(f"{name} needs {len(choices)} values, got {_show(value)}")
    return tuple(_checked(v, hint, name) for v, hint in zip(value, choices, strict=True))


def _plain(value: Any, hint: Any, name: str) -> Any:
    """A number, a text, a path or an object of another class."""
    if hint is Path:
        if isinstance(value, str | Path):
            return Path(value)
        raise ValueError(f"{name} must be a path, got {_show(value)}")
    if hint not in KINDS:
        if isinstance(value, hint):
            return value
        raise ValueError(f"{name} must be of type {hint.__name__}, got {_show(value)}")
    is_bool = isinstance(value, bool | np.bool_)
    fits = isinstance(value, hint) or (hint is not str and isinstance(value, KINDS[hint]))
    if not fits or is_bool != (hint is bool):
        raise ValueError(f"{name} must be {NAMES[hint]}, got {_show(value)}")
    if hint is int and not abs(int(value)) < INTEGER:
        raise ValueError(f"{name} must lie between -2**63 and 2**63, got {_show(value)}")
    if hint is float and not abs(value.item() if isinstance(value, np.generic) else value) < FINITE:
        raise ValueError(f"{name} must be a finite number, got {_show(value)}")
    return hint(value)


def _show(value: Any) -> str:
    """A value in a few characters of one line."""
    return f"{str(value)[:60]!r}" if isinstance(value, str) else str(value)[:60]
