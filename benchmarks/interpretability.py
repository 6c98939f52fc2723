"""What FuzzIC 0.5.2 says of rule bases: published criteria of interpretability, by others' code.

Each membership function of a rule is a fuzzy set of its input, the action that the rule would
choose by itself its conclusion; the states of a trial without learning are the data. FuzzIC pools
criteria of complexity (rules, fuzzy sets of an input, rules that fire together, ...) and of
semantics (fuzzy sets that can be told apart, that cover the range, rules that do not contradict,
...) to a number from 0 to 1 each, the greater the better. It takes all inputs as lines: a heading
does not wrap. Left out are criteria that need files of its own (prototypes, orders, sharing). An
input has 50 points instead of 1,000, with which hundreds of rules take an hour.

    pip install fuzzic==0.5.2
    python benchmarks/interpretability.py runs/sixty runs/sixty-40-rules runs/sixty-20-rules
"""

import argparse
import contextlib
import io
from pathlib import Path

import numpy as np
from fuzzic.configuration.config import config as fuzzic_config
from fuzzic.interpretability import criteria_engine, dataset, interpretability_manager
from fuzzic.interpretability import rulebase as theirs

from sofnn_torch.evaluate import load
from sofnn_torch.learners.learner import Learner
from sofnn_torch.rules import played
from sofnn_torch.runs.session import arithmetic

RESOLUTION = 50  # points of the range of an input
FILES = ["prototype", "preservation order", "membership function sharing"]
SHOWN = [
    "number of rules",
    "justifiable number of elements",
    "number rules activated",
    "distinguishability",
    "coverage",
]


def rule_base(agent: Learner, states: np.ndarray) -> theirs.Rulebase:
    """The rules of a learner with actions to choose among, as FuzzIC has them.

    Raises:
        ValueError: actions are numbers, or inputs of the rules.
    """
    said = agent.alone(agent.conclusions(agent.net.centres)[1]) if agent.choices else None
    if said is None:
        raise ValueError("only rules that choose an action by themselves can be compared")
    base = theirs.Rulebase(label="rules")
    sets = []
    for i, axis in enumerate(agent.inputs):
        variable = theirs.Variable(axis.name, base, axis.unit, [axis.low, axis.high], [], str(i))
        for k, (u, v) in enumerate(
            zip(agent.net.centres[:, i].tolist(), agent.net.widths[:, i].tolist(), strict=True)
        ):
            bell = theirs.Gaussian(u, v)
            name = f"{i}-{k}"
            one = theirs.MF(name, "gaussian", variable, gaussian=bell, ident=name)
            variable.all_mf.append(one)
        base.var[variable.ident] = variable
        sets.append(variable)
    ends = [0, max(1, len(agent.choices) - 1)]
    action = theirs.Variable("action", base, "", ends, [], "action")
    points = {
        j: theirs.MF(name, "one_point", action, [theirs.Point(j, 1)], ident=name)
        for j, name in enumerate((*agent.choices, "undecided"))
    }
    for k, j in enumerate(said.tolist()):
        premise = {theirs.Term(variable, variable.all_mf[k]) for variable in sets}
        base.rules[str(k)] = theirs.Rule(str(k), premise, {theirs.Term(action, points[j])})
    base.used_variables = dict(base.var)
    low, high = (np.array([getattr(axis, end) for axis in agent.inputs]) for end in ("low", "high"))
    rows = np.clip(states, low, high).astype(float).tolist()
    base.dataset = dataset.Dataset([[variable.label for variable in sets], *rows], base)
    return base


@arithmetic()
def main() -> None:
    """Print a line of Markdown for each run, or say why it has none."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+")
    options = parser.parse_args()
    fuzzic_config.space_discretization = RESOLUTION
    interpretability_manager.deactivate(FILES)
    print(f"| run | complexity | semantics | {' | '.join(SHOWN)} |")
    print(f"| --- |{' ---: |' * (2 + len(SHOWN))}")
    for run in options.runs:
        config, agent, _, _ = load(run)
        states = played.trial(config, agent, 1, 1000).states
        np.random.seed(0)  # FuzzIC samples more states like these from the global generator
        with contextlib.redirect_stdout(io.StringIO()):
            found = interpretability_manager.evaluate_interpretability_rulebase(
                rule_base(agent, states)
            )
        pooled = [
            criteria_engine.score_pooling(found, kind) for kind in ("complexity", "semantics")
        ]
        cells = [*pooled, *(found[name]["score"] for name in SHOWN)]
        print(f"| {run.name} | {' | '.join(f'{cell:.2f}' for cell in cells)} |", flush=True)


if __name__ == "__main__":
    main()
