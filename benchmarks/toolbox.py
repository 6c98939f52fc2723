"""Speed against neuro-fuzzy-toolbox 0.3.0, the growing neuro-fuzzy network on PyPI.

Both networks have three inputs and ten parameters a rule: Gaussian centres and widths, and four
consequents (the toolbox: a linear function of the state; ours: four outputs). Forward and backward
pass at batch size 1 and 64, and adding one rule with given consequents; alternately in one
process, medians of the ratios. In both, numbers below 1e-38 count as 0. The toolbox has no inputs
that wrap: ours is measured without them, and apart with the robot's heading as the third.

    pip install neuro-fuzzy-toolbox==0.3.0
    python benchmarks/toolbox.py --out toolbox.json
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from learning import SIZES, both_passes, fill, states
from neuro_fuzzy_toolbox.func import Gaussian_MF
from neuro_fuzzy_toolbox.models.anfis import rule_reduced_ANFIS
from timing import arguments, interleaved, median, ratio, report

from sofnn_torch.network.axes import Axis
from sofnn_torch.network.sofnn import SOFNN
from sofnn_torch.runs.session import arithmetic


def ours(rules: int, period: float = 0.0) -> SOFNN:
    """Return a growing network with a number of rules; the third input may have a period."""
    widths = (0.06, 0.06, 0.45)
    axes = Axis("x"), Axis("y"), Axis("heading", period=period)
    net = SOFNN(axes, 4, width=widths, interpolate=False)
    fill(net, rules)
    return net


def adding(net: SOFNN) -> Callable[[], Any]:
    """Return a function that adds one rule to ours."""
    centres = iter(torch.from_numpy(states(200_000, seed=2)))
    return lambda: net.add_rule(next(centres))


def adding_to(toolbox: rule_reduced_ANFIS) -> Callable[[], Any]:
    """Return a function that adds one rule to the toolbox's."""
    mean, deviation = torch.rand(1, 3), torch.full((1, 3), 0.3)
    return lambda: toolbox.add_rules(mean, deviation)


@arithmetic()
def main() -> None:
    """Measure, print a table, and write it as JSON."""
    options = arguments(__doc__, repeats=5)
    rows = []
    for rules in SIZES:
        net, angle = ours(rules), ours(rules, 2 * np.pi)
        toolbox = rule_reduced_ANFIS(3, rules, membership_function=Gaussian_MF())
        tasks: dict[str, list[Callable[[], Any]]] = {
            f"forward + backward, batch {batch}": [
                both_passes(each, batch) for each in (toolbox, net, angle)
            ]
            for batch in (1, 64)
        }
        tasks["adding a rule"] = [adding_to(toolbox), adding(net), adding(angle)]
        for task, (theirs, plain, wrapping) in tasks.items():
            functions = {"toolbox": theirs, "ours": plain, "with a heading": wrapping}
            times = interleaved(functions, options.repeats, seconds=0.2)
            row = {"task": task, "rules": rules}
            row |= {f"{name} us": median(values) for name, values in times.items()}
            row |= {"ratio": ratio(times["toolbox"], times["ours"])}
            rows.append(row | {"its ratio": ratio(times["toolbox"], times["with a heading"])})
    report(options, toolbox=rows)


if __name__ == "__main__":
    main()
