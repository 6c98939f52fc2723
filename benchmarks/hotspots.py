"""Where the time of a training run goes: a sampling profile of `train.py` by py-spy.

Each sample is counted for the innermost function of this project on the stack, with what it had
called outside. `--checkout` profiles another checkout, for a before and after.

    pip install -e ".[benchmark]"
    python benchmarks/hotspots.py --out hotspots.json
    python benchmarks/hotspots.py --flags "--agent q --trials 60" --checkout ../before
"""

import re
import shlex
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

from timing import arguments, report

HERE = Path(__file__).parents[1]
FRAME = re.compile(r"([^;]+) \(([^;:]+)[^;]*\)")
RECORD = ("record", "--rate", "500", "--format", "raw", "--output")
QUIET = ("--quiet", "--picture-every", "0", "--video-every", "0")
TOP = 14


def profile(checkout: Path, flags: list[str]) -> tuple[Counter[str], float]:
    """Samples by function, and the seconds of the run."""
    with tempfile.TemporaryDirectory() as place:
        stacks = Path(place, "stacks.txt")
        command = [Path(sys.executable).with_name("py-spy"), *RECORD, stacks]
        command += ["--", sys.executable, checkout / "train.py", *flags, *QUIET]
        command += ["--runs", Path(place, "runs")]
        subprocess.run(command, check=True, cwd=checkout, capture_output=True)
        samples: Counter[str] = Counter()
        for line in stacks.read_text().splitlines():
            stack, _, count = line.rpartition(" ")
            samples[innermost(FRAME.findall(stack))] += int(count)
    return samples, sum(samples.values()) / 500


def innermost(frames: list[tuple[str, str]]) -> str:
    """The function of this project that a stack is in, and whether autograd is at work there."""
    ours = [i for i, (_, file) in enumerate(frames) if file.startswith("sofnn_torch/")]
    if not ours:
        return "imports and start"
    if not any(name == "play" for name, _ in frames):
        return "between trials: records, checkpoints, curves; start"
    name, file = frames[ours[-1]]
    inside = [name for name, file in frames[ours[-1] :] if file.startswith("torch/autograd")]
    return f"{Path(file).stem}: {name}{', autograd' if inside else ''}"


def main() -> None:
    """Profile, print a table, and write it as JSON."""
    text = "directory of another checkout"
    options = arguments(__doc__, repeats=1, flags="--trials 60", checkout=text)
    samples, seconds = profile((options.checkout or HERE).resolve(), options.flags)
    rows = [
        {"function": name, "% of the time": 100 * count / samples.total()}
        for name, count in samples.most_common(TOP)
    ]
    run = [{"flags": shlex.join(options.flags), "seconds": seconds, "samples": samples.total()}]
    report(options, run=run, functions=rows)


if __name__ == "__main__":
    main()
