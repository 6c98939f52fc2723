"""What a policy survives on its way to a robot: trials of exported policies, fault by fault.

    python examples/robot/survives.py runs/sga-* runs/q-* > table.md

Each policy is exported, read again, and drives the simulated robot of simulated.py: the same lines
as over a socket, without waiting for one.
"""

import argparse
import itertools
import statistics
import tempfile
from pathlib import Path

from drive import Driver
from simulated import Faults, SimulatedRobot

from sofnn_torch.evaluate import load
from sofnn_torch.export import policy, runtime

FAULTS = {
    "none but the motor noise of 10 %": Faults(),
    "lines 100 ms late, there and back": Faults(late=0.1),
    "lines 250 ms late, there and back": Faults(late=0.25),
    "10 % of the lines lost, there and back": Faults(lost=0.1),
    "30 % of the lines lost, there and back": Faults(lost=0.3),
    "left motor 10 % weaker": Faults(left=0.9),
    "left motor 10 % stronger": Faults(left=1.1),
    "100 ms, 10 % lost and left motor 10 % weaker": Faults(0.1, 0.1, left=0.9),
    "wheels 10 % larger than believed": Faults(radius=1.1),
    "wheels 10 % smaller than believed": Faults(radius=0.9),
    "wheels 10 % farther apart than believed": Faults(base=1.1),
    "wheels 10 % closer than believed": Faults(base=0.9),
}


def drive(data: dict, faults: Faults, trials: int, limit: int, seed: int = 0) -> list[int | None]:
    """Steps of some trials of a policy on the simulated robot, None where it did not arrive."""
    driver = Driver(runtime.Policy(data, seed), SimulatedRobot(faults, seed).answer)
    return [driver.trial(limit) for _ in range(trials)]


def exported(run: Path) -> dict:
    """The policy of a run, through its file."""
    loaded = load(run, best=False)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "policy.json"
        path.write_bytes(policy.to_json(policy.describe(loaded.config, loaded.agent)))
        return runtime.read(path).data


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--trials", type=int, default=4, help="of each policy with each fault")
    parser.add_argument("--limit", type=int, default=2000, help="steps of a trial, of 0.5 s")
    options = parser.parse_args()
    policies: dict[str, list[dict]] = {}
    for run in options.runs:
        data = exported(run)
        policies.setdefault(data["learner"], []).append(data)
    names = {name: f"{name} ({len(found)} runs)" for name, found in policies.items()}
    print("| Fault | " + " | ".join(f"{n}: arrived | steps, median" for n in names.values()) + " |")
    print("| --- |" + " ---: | ---: |" * len(policies), flush=True)
    for fault, faults in FAULTS.items():
        cells = []
        for found in policies.values():
            trials = itertools.chain.from_iterable(
                drive(data, faults, options.trials, options.limit, seed)
                for seed, data in enumerate(found)
            )
            steps = list(trials)
            arrived = [count for count in steps if count is not None]
            middle = f"{statistics.median(arrived):.0f}" if arrived else "-"
            cells += [f"{len(arrived)} of {len(steps)}", middle]
        print(f"| {fault} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
