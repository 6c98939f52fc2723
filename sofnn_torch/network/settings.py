"""Settings of the network."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from sofnn_torch.bounds import Positive, Settings, Within
from sofnn_torch.network.axes import Axis
from sofnn_torch.network.growth import criterion

Rules = Annotated[int, Within(above=0)]


@dataclass(frozen=True)
class NetworkConfig(Settings, table="net"):
    """Section 2: the fuzzy network.

    Examples:
        >>> NetworkConfig(grid=(4,)).along(inputs=3)
        (4, 4, 4)
    """

    theta: Annotated[float, Within(above=0, below=1)] = 0.4
    """Growth threshold theta_th of eq. 3: a rule is added where firing stays below it."""
    growth: str = "rule"
    """Reading of eq. 3: `rule`, `input`, `literal`, `frozen` (never adds a rule), or `module:Class`
    of one's own."""
    width_position: Positive = 0.06
    """Width v of new membership functions on x and y, in metres."""
    width_heading: Positive = 0.45
    """Width v of new membership functions on the heading, in radians."""
    width: Annotated[tuple[float, ...], Within(above=0)] = (0.1,)
    """Width v of new membership functions as a share of the range of each input, or one for all
    inputs; in tasks other than the maze."""
    width_action: Positive = 0.3
    """Width v on the action, where the action is an antecedent (`--q.coding antecedent`)."""
    interpolate: bool = False
    """A new rule takes over the policy that the network had there (SGA), or the action values
    (Q-learning), instead of the initial ones."""
    grid: Annotated[tuple[int, ...], Within(above=0)] = (12, 12, 8)
    """Rules along each input of the fixed network, or one number for all inputs; along x, y and
    heading in the maze (12 12 8 and 24 24 16 in the paper)."""
    grid_action: Rules = 8
    """Rules along the action of the fixed network, where the action is an antecedent."""
    max_rules: Annotated[Rules, Within(most=10_000_000), tyro.conf.arg(aliases=["--max-rules"])] = (
        50_000
    )
    """Hard limit; beyond it no rule is added and a warning is shown."""

    def __post_init__(self) -> None:
        """Check the numbers, and that there is such a criterion."""
        super().__post_init__()
        criterion(self.growth, self.theta)

    def task_widths(self, axes: Sequence[Axis], acting: bool = False) -> list[float]:
        """Widths of new membership functions on axes with ends, in their units.

        Args:
            axes: of the state.
            acting: the action is one more input.

        Raises:
            ValueError: `width` has neither one value nor one for each axis.
        """
        shares = _each(self.width, len(axes), "--net.width")
        widths = [v * (axis.high - axis.low) for v, axis in zip(shares, axes, strict=True)]
        return [*widths, self.width_action] if acting else widths

    def along(self, inputs: int, acting: bool = False) -> tuple[int, ...]:
        """Rules of the fixed network along each of the inputs of a state, and along the action.

        Raises:
            ValueError: `grid` has neither one value nor one for each input.
        """
        along = _each(self.grid, inputs, "--net.grid")
        return (*along, self.grid_action) if acting else along


def _each(values: tuple[Any, ...], count: int, name: str) -> tuple[Any, ...]:
    """The values for each of the inputs, from as many or from one for all."""
    if len(values) not in (1, count):
        raise ValueError(f"{name} needs {count} values or one, got {len(values)}")
    return values * count if len(values) == 1 else values
