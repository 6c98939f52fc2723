"""Settings of the network."""

from dataclasses import dataclass
from typing import Annotated

import tyro

from sofnn_torch.bounds import Positive, Settings, Within
from sofnn_torch.network.growth import criterion

Rules = Annotated[int, Within(above=0)]


@dataclass(frozen=True)
class NetworkConfig(Settings, table="net"):
    """Section 2: the fuzzy network."""

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
