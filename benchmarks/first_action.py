"""How long a policy without torch takes from its start to its first action.

    python -m sofnn_torch.export RUN --to policy.json
    python benchmarks/first_action.py policy.json --repeats 10

Each start is followed by one of Python with NumPy alone, on the same machine in the same moment.
Prints medians and greatest of both, in seconds of the clock and of the processor.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np


def seconds(call: list[str], line: str) -> tuple[float, float]:
    """Seconds of the clock and of the processor that a program takes for a line."""
    used, begin = os.times(), time.perf_counter()
    subprocess.run(call, input=line, stdout=subprocess.DEVNULL, text=True, check=True)
    clock, after = time.perf_counter() - begin, os.times()
    parts = (after.children_user, after.children_system)
    return clock, sum(parts) - used.children_user - used.children_system


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", type=Path, help="exported .json, the runtime beside it")
    parser.add_argument("--repeats", type=int, default=10)
    options = parser.parse_args()
    inputs = len(json.loads(options.policy.read_text())["axes"])
    runtime, line = options.policy.with_name("sofnn_runtime.py"), "0.5 " * inputs + "\n"
    calls = {
        "first action": [sys.executable, "-I", str(runtime), str(options.policy)],
        "NumPy alone": [sys.executable, "-I", "-c", "import numpy"],
    }
    times = [[seconds(call, line) for call in calls.values()] for _ in range(options.repeats)]
    for name, found in zip(calls, np.array(times).transpose(1, 2, 0), strict=True):
        clock, processor = found
        print(
            f"{name}: clock {np.median(clock):.3f} s, at most {clock.max():.3f}; "
            f"processor {np.median(processor):.3f} s, at most {processor.max():.3f}"
        )


if __name__ == "__main__":
    main()
