"""Speed against neuro-fuzzy-toolbox 0.3.0, the growing neuro-fuzzy network on PyPI.

Both networks have three inputs and ten parameters a rule: Gaussian centres and widths, and four
consequents (the toolbox: a linear function of the state; ours: four outputs). Forward and backward
pass at batch size 1 and 64, and adding one rule with given consequents; alternately in one
process, medians of the ratios. In both, numbers below 1e-38 count as 0.

    pip install neuro-fuzzy-toolbox==0.3.0
    python benchmarks/toolbox.py --out toolbox.json
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from learning import SIZES, fill, states
from neuro_fuzzy_toolbox.func import Gaussian_MF
from neuro_fuzzy_toolbox.models.anfis import rule_reduced_ANFIS
from timing import arguments, interleaved, median, ratio, report

from sofnn_torch.session import arithmetic
from sofnn_torch.sofnn import SOFNN


def ours(rules: int) -> SOFNN:
    """Return a growing network with a number of rules."""
    widths = (0.06, 0.06, 0.45)
    net = SOFNN(3, 4, width=widths, periods=(0, 0, 2 * np.pi), interpolate=False)
    fill(net, rules)
    return net


def both_passes(net: torch.nn.Module, batch: int) -> Callable[[], Any]:
    """Return a function that runs the forward and the backward pass."""
    x = torch.from_numpy(states(batch, seed=1))

    def run() -> None:
        net.zero_grad()
        net(x).sum().backward()

    return run


def additions(net: SOFNN, toolbox: rule_reduced_ANFIS) -> dict[str, Callable[[], Any]]:
    """Return functions that add one rule."""
    centres = iter(torch.from_numpy(states(200_000, seed=2)))
    mean, deviation = torch.rand(1, 3), torch.full((1, 3), 0.3)
    return {
        "ours": lambda: net.add_rule(next(centres)),
        "toolbox": lambda: toolbox.add_rules(mean, deviation),
    }


@arithmetic()
def main() -> None:
    """Measure, print a table, and write it as JSON."""
    options = arguments(__doc__, repeats=5)
    rows = []
    for rules in SIZES:
        net = ours(rules)
        toolbox = rule_reduced_ANFIS(3, rules, membership_function=Gaussian_MF())
        tasks = {
            f"forward + backward, batch {batch}": {
                "ours": both_passes(net, batch),
                "toolbox": both_passes(toolbox, batch),
            }
            for batch in (1, 64)
        }
        for task, functions in (tasks | {"adding a rule": additions(net, toolbox)}).items():
            times = interleaved(functions, options.repeats)
            row = {"task": task, "rules": rules}
            row |= {f"{name} us": median(values) for name, values in times.items()}
            rows.append(row | {"ratio": ratio(times["toolbox"], times["ours"])})
    report(options, toolbox=rows)


if __name__ == "__main__":
    main()
