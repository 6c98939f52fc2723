"""What the defaults learn on Gymnasium's classic tasks: the greedy policy after some trials.

    python benchmarks/tasks.py --out tasks.json
    python benchmarks/tasks.py --env MountainCar-v0 --agent q --seeds 20 --trials 200

Each seed trains with the preset ``default`` and plays 20 trials without learning or exploration.
Returns are means over these; the table has all seeds. Runs stay in ``--runs`` and are not repeated.
"""

import dataclasses
import json
from pathlib import Path
from statistics import mean
from typing import Annotated

import tyro

from sofnn_torch import Config, RunOptions, load, train
from sofnn_torch.evaluate import evaluate
from sofnn_torch.pictures.figures import read_column

TRIALS = {"MountainCar-v0": 150, "CartPole-v1": 120}


@dataclasses.dataclass
class Options:
    """Train the defaults on tasks and play what they learned."""

    env: tuple[str, ...] = tuple(TRIALS)
    """Tasks."""
    agent: tuple[str, ...] = ("sga", "q")
    """Learners."""
    seeds: int = 5
    """Seeds 0, 1, ... of each."""
    trials: int | None = None
    """Trials of training; by default 150 of MountainCar, 120 of CartPole, 100 of others."""
    runs: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("runs/tasks")
    """Where the runs go."""
    out: Path | None = None
    """Write the table as JSON."""


def learned(env: str, agent: str, seed: int, trials: int, runs: Path) -> dict[str, float]:
    """Steps of training, rules, and the mean return of 20 greedy trials of one seed."""
    name = f"{env}-{agent}-{trials}-s{seed}"
    config = Config(env=env, agent=agent, seed=seed, trials=trials)
    run = runs / name
    if not run.exists():
        train(config, RunOptions(runs=runs, name=name, quiet=True, picture_every=0))
    config, learner, _, _ = load(run)
    records = evaluate(config, learner, 20)
    steps = int(read_column(run / "trials.csv", "steps").sum())
    reward = mean(record.reward for record in records)
    return {"seed": seed, "steps": steps, "rules": learner.net.n_rules, "return": reward}


def main() -> None:
    """Print a line for each seed and for each cell of the table."""
    options = tyro.cli(Options, description=__doc__)
    table = []
    for env in options.env:
        for agent in options.agent:
            trials = options.trials or TRIALS.get(env, 100)
            rows = []
            for seed in range(options.seeds):
                rows.append(learned(env, agent, seed, trials, options.runs))
                print(env, agent, *(f"{k} {v:,.4g}" for k, v in rows[-1].items()), flush=True)
            table.append({"env": env, "agent": agent, "trials": trials, "seeds": rows})
            print(f"{env} {agent}: mean return {mean(r['return'] for r in rows):.1f}", flush=True)
    if options.out:
        options.out.write_text(json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
