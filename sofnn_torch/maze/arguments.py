"""Arguments as they come from anywhere, as plain Python values or refused in one line."""

import math
import numbers
from typing import Any

import numpy as np

MOST = 2**63 - 1  # what an array of whole numbers can hold
COUNTS = {1: "one", 2: "two", 3: "three"}


def show(value: Any) -> str:
    """Return a value in a few characters of one line."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def choice(name: str, value: Any, choices: tuple[str | None, ...]) -> Any:
    """Return one of some choices.

    Raises:
        ValueError: if the value is none of them.
    """
    if not isinstance(value, str | None) or value not in choices:
        raise ValueError(f"{name} must be one of {choices}, not {show(value)}")
    return value


def real(name: str, value: Any) -> float:
    """Return a finite number, which may have been one of NumPy's.

    Raises:
        ValueError: if the value is anything else.
    """
    plain = isinstance(value, numbers.Real) and not isinstance(value, bool)
    try:
        finite = plain and math.isfinite(value)
    except OverflowError:  # a whole number beyond all floats
        finite = False
    if not finite:
        raise ValueError(f"{name} must be a finite number, not {show(value)}")
    return float(value)


def whole(name: str, value: Any, most: int = MOST) -> int:
    """Return a whole number from 1 to `most`, which may have been one of NumPy's.

    Raises:
        ValueError: if the value is anything else.
    """
    plain = isinstance(value, numbers.Real) and not isinstance(value, bool)
    if not plain or not 1 <= value <= most or value != int(value):
        bounds = "of at least 1" if most == MOST else f"from 1 to {most}"
        raise ValueError(f"{name} must be a whole number {bounds}, not {show(value)}")
    return int(value)


def vector(name: str, value: Any, size: int, bound: float = math.inf) -> list[float]:
    """Return finite numbers from a list, an array or a tensor of any shape, or from one number.

    Raises:
        ValueError: if there are not `size` of them, or one lies outside [-bound, bound].
    """
    try:
        array = np.asarray(value)
    except Exception:  # ragged lists and foreign tensors fail in ways of their own
        array = np.asarray(None)
    if array.dtype.kind in "iuf" and array.size == size:
        values = array.astype(np.float64).ravel().tolist()
        if all(math.isfinite(number) and abs(number) <= bound for number in values):
            return values
    count = COUNTS.get(size, str(size)) + " finite" * (bound == math.inf)
    limits = "" if bound == math.inf else f" in [-{bound:g}, {bound:g}]"
    raise ValueError(f"{name} must be {count} number{'s' * (size > 1)}{limits}, not {show(value)}")
