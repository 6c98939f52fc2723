"""Trials to learn with ten rules by hand, against a start from nothing.

Each arm is trained with the presets (`train.py`, and `train.py --rules examples/rules/AGENT.csv`)
until it has learned: ten trials in a row under 1.5 times the shortest way; the last of them counts.
With rules it goes on to the last trial, so that what is lost later shows too. Shown are the steps
of the first trial, the most steps in trials 2 to 10, the median trial at which it had learned, and,
with rules, the steps in the last ten trials and how many trials were longer than 1.5 times the
shortest way. One row for each seed goes to the JSON file.

    python benchmarks/given.py --out given.json --seeds 10 --trials 60
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from sofnn_torch.maze.optimum import mean_optimum
from sofnn_torch.runs import session
from sofnn_torch.runs.factory import make_plan
from sofnn_torch.runs.session import arithmetic
from sofnn_torch.runs.settings import Config
from sofnn_torch.studies.collecting import IN_A_ROW, WITHIN
from sofnn_torch.training import play

RULES = Path(__file__).parents[1] / "examples" / "rules"


def learn(config: Config, limit: float, until_learned: bool) -> dict[str, Any]:
    """Steps of each trial, and the trial at which it had learned; None if it never had."""
    agent, env = session.build(config)
    steps: list[int] = []
    learned = None
    while len(steps) < config.trials and not (learned and until_learned):
        record, _ = play(env, agent)
        steps.append(record.steps)
        row = steps[-IN_A_ROW:]
        if learned is None and len(row) == IN_A_ROW and max(row) < limit:
            learned = len(steps)
    env.close()
    return {"learned": learned, "rules": agent.net.n_rules, "steps": steps}


def summary(rows: list[dict[str, Any]], trials: int, limit: float) -> str:
    """One line of the table."""
    steps = [row["steps"] for row in rows]
    worst = max(max(s[1:10]) / s[0] for s in steps)
    when = np.median([row["learned"] or trials + 1 for row in rows])
    text = f"first {np.median([s[0] for s in steps]):,.0f} (at most {max(s[0] for s in steps):,})"
    text += f", trials 2-10 at most {max(max(s[1:10]) for s in steps):,} ({worst:.2f} times the "
    text += f"first), learned at {when:g} ({sum(r['learned'] is not None for r in rows)} seeds)"
    if all(len(s) == trials for s in steps):
        longer = sum(sum(n > limit for n in s) for s in steps)
        last = np.median([np.mean(s[-IN_A_ROW:]) for s in steps])
        text += f", last ten {last:,.0f}, {longer} of {trials * len(steps)} trials longer"
    return text


@arithmetic()
def main() -> None:
    """Train all arms, print a line for each, and write all numbers."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--trials", type=int, default=60)
    parser.add_argument("--agents", nargs="+", default=["sga", "q"])
    parser.add_argument("--only", choices=["nothing", "rules"])
    options = parser.parse_args()
    found: dict[str, Any] = {}
    for agent in options.agents:
        for arm in [options.only] if options.only else ["rules", "nothing"]:
            rules = str(RULES / f"{agent}.csv") if arm == "rules" else ""
            rows = []
            for seed in range(options.seeds):
                config = Config(agent=agent, rules=rules, seed=seed, trials=options.trials)
                plan = make_plan(config)
                limit = WITHIN * mean_optimum(plan, config.maze.hold)
                rows.append({"seed": seed} | learn(config, limit, arm == "nothing"))
                print(f"{agent} from {arm}, seed {seed}:", *rows[-1]["steps"], flush=True)
            found[f"{agent} from {arm}"] = rows
            print(f"{agent} from {arm}: {summary(rows, options.trials, limit)}", flush=True)
            if options.out:
                options.out.write_text(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
