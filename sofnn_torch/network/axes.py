"""The inputs of a network: what each is called and measured in, where it lies, whether it wraps."""

import math
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Axis:
    """One input of a network.

    Args:
        name: what it is called, in rules and on pictures.
        unit: what it is measured in.
        low: lower end of its range, in its unit; -inf where it has none.
        high: upper end of its range; inf where it has none.
        period: length of a whole turn, in its unit; 0 for an input that does not wrap.

    Raises:
        ValueError: the range is empty, or the period is negative or not finite.

    Examples:
        >>> Axis("heading", "rad", -math.pi, math.pi, period=2 * math.pi).bounded
        True
    """

    name: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    period: float = 0.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not self.low < self.high:
            raise ValueError(f"axis {self.name}: low must be under high, got {self.low, self.high}")
        if not 0 <= self.period < math.inf:
            raise ValueError(
                f"axis {self.name}: the period must be positive, or 0 for an input that does not "
                f"wrap, got {self.period}"
            )

    @property
    def bounded(self) -> bool:
        """Whether both ends of the range are finite."""
        return math.isfinite(self.low) and math.isfinite(self.high)


def named(inputs: int | Sequence[Axis]) -> tuple[Axis, ...]:
    """The axes themselves, or for a number of inputs as many: x1, x2, ... without ends.

    Raises:
        ValueError: there is no input, or two have one name.
    """
    if isinstance(inputs, int):
        inputs = [Axis(f"x{i + 1}") for i in range(inputs)]
    names = [axis.name for axis in inputs]
    if not names:
        raise ValueError("a network needs at least one input")
    if len(set(names)) < len(names):
        raise ValueError(f"every input needs a name of its own, got {names}")
    return tuple(inputs)
