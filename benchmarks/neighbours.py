"""What a neighbourhood search would bring: the firing of the near rules only, against all.

A rule whose position lies more than ``reach`` widths away fires at most exp(-reach^2 / 2). Where
the best rule fires at least ``theta`` (equation 3 sees to that), what ``K`` rules beyond the reach
add to the normalised firing is at most K exp(-reach^2 / 2) / theta; printed beside it is what they
did add. The search is the cheapest there is: positions are sorted into square cells as wide as the
reach once, the rules of the cells around a state are looked up, and their columns are gathered.
Traces are left out: those of the far rules have to decay as well, which needs all rules again.

    python benchmarks/neighbours.py --out neighbours.json
"""

import math
from collections.abc import Callable
from itertools import cycle
from typing import Any

import torch
from learning import fill, states
from timing import arguments, interleaved, median, ratio, report
from torch import Tensor

from sofnn_torch.maze.settings import POSE
from sofnn_torch.network.sofnn import SOFNN
from sofnn_torch.runs.session import arithmetic
from sofnn_torch.runs.settings import Config

SIZES = (1_000, 10_000, 100_000)
REACHES = (4.0, 7.0)  # widths


class Cells:
    """The rules of a network by square cells of their positions."""

    def __init__(self, net: SOFNN, side: float):
        self.net, self.side = net, side
        self.cells = (net.centres[:, :2] / side).floor().long()
        self.around: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}

    def near(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Antecedents of the rules in the cells around the state x (n,), copied together once."""
        position = x[:2].tolist()
        cell = (int(position[0] // self.side), int(position[1] // self.side))
        if cell not in self.around:
            index = ((self.cells - torch.tensor(cell)).abs() <= 1).all(1).nonzero()[:, 0]
            self.around[cell] = index, self.net.table().detach()[:6, index]
        return self.around[cell]

    def conclude(self, x: Tensor) -> Tensor:
        """Outputs (m,) of the network from the near rules alone."""
        index, antecedents = self.near(x)
        firing = self.net.normalised_firing(x, antecedents.split_with_sizes((3, 3)))
        return self.net.consequents.T.index_select(1, index) @ firing


def error(net: SOFNN, cells: Cells, xs: Tensor) -> float:
    """The largest share of the firing that the rules out of reach had at a state."""
    missed = []
    for x in xs:
        firing = net.normalised_firing(x[None])[0]
        missed.append(1 - firing[cells.near(x)[0]].double().sum().item())
    return max(0.0, *missed)


@arithmetic()
def main() -> None:
    """Measure, print a table, and write it as JSON."""
    options = arguments(__doc__, repeats=15)
    config = Config(agent="sga", network="sofnn").net
    widths = (config.width_position, config.width_position, config.width_heading)
    xs = torch.from_numpy(states(2_000, seed=1))
    rows = []
    for rules in SIZES:
        net = SOFNN(POSE, 3, width=widths)
        fill(net, rules)
        for reach in REACHES:
            cells = Cells(net, reach * config.width_position)
            turns = cycle(xs), cycle(xs)

            def near(cells: Cells = cells, turn: Any = turns[0]) -> Tensor:
                return cells.conclude(next(turn))

            def everywhere(net: SOFNN = net, turn: Any = turns[1]) -> Tensor:
                return net.conclude(net.normalised_firing(next(turn)))

            functions: dict[str, Callable[[], Any]] = {"near": near, "all": everywhere}
            with torch.no_grad():
                times = interleaved(functions, options.repeats)
                share = sum(len(cells.near(x)[0]) for x in xs) / len(xs) / rules
                lost = error(net, cells, xs[:200])
            bound = rules * math.exp(-0.5 * reach * reach) / config.theta
            rows.append(
                {
                    "rules": rules,
                    "reach": reach,
                    "share looked at": share,
                    "error bound": f"{bound:.1e}",
                    "error": f"{lost:.1e}",
                    "near us": median(times["near"]),
                    "all us": median(times["all"]),
                    "near over all": ratio(times["near"], times["all"]),
                }
            )
    report(options, neighbourhood=rows)


if __name__ == "__main__":
    main()
