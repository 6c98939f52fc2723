"""Memory of one process over two million simulator steps of training, pictures included.

    python benchmarks/soak.py --out docs/images

trains in the ordinary way, samples the process's memory, stops itself as Ctrl-C would, prints a
table, and writes soak-<agent>.json and soak-<agent>.png.
"""

import json
import os
import signal
import tempfile
import threading
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import psutil
import tyro

from sofnn_torch import training
from sofnn_torch.pictures import figures
from sofnn_torch.runs.session import RunOptions
from sofnn_torch.runs.settings import Config
from sofnn_torch.runs.signals import Interrupted


@dataclass(frozen=True)
class Soak:
    """How long, and where the results go."""

    steps: int = 2_000_000
    """Simulator steps."""
    agent: str = "sga"
    """Learner, sga or q."""
    seconds: float = 2.0
    """Time between two samples."""
    out: Path = Path(".")
    """Directory of soak-<agent>.json and soak-<agent>.png."""


def watch(table: Path, soak: Soak, samples: list[dict[str, float]], over: threading.Event) -> None:
    """Sample memory and progress until the steps are done, then ask the training to stop."""
    process = psutil.Process()
    while not over.wait(soak.seconds):
        if not table.exists():
            continue
        trial = dict(zip(*_ends(table), strict=False))
        samples.append(
            {
                "steps": int(trial["total_steps"]),
                "rules": int(trial["rules"]),
                "mebibytes": process.memory_info().rss / 2**20,
                "files": process.num_fds(),
                "threads": process.num_threads(),
            }
        )
        if samples[-1]["steps"] >= soak.steps:
            os.kill(os.getpid(), signal.SIGINT)
            return


def _ends(table: Path) -> tuple[list[str], list[str]]:
    """First and last whole line of the trial table."""
    lines = table.read_text().splitlines(keepends=True)
    whole = [line for line in lines if line.endswith("\n")]
    return whole[0].strip().split(","), whole[-1].strip().split(",")


def main() -> None:
    """Train, sample, report."""
    soak = tyro.cli(Soak, description=__doc__)
    config = replace(Config(agent=soak.agent, network="sofnn"), trials=1_000_000)
    samples: list[dict[str, float]] = []
    over = threading.Event()
    with tempfile.TemporaryDirectory() as runs:
        options = RunOptions(runs=Path(runs), name="soak", video_every=0, quiet=True)
        table = Path(runs, "soak", "trials.csv")
        watcher = threading.Thread(target=watch, args=(table, soak, samples, over))
        watcher.start()
        try:
            training.train(config, options)
        except Interrupted:
            pass
        finally:
            over.set()
            watcher.join()
        log = sum(path.stat().st_size for path in Path(runs, "soak").iterdir()) / 2**20
    report(samples, log, soak)


@figures.styled
def report(samples: list[dict[str, float]], log: float, soak: Soak) -> None:
    """Print a table and write the samples and their plot."""
    columns = {name: np.array([sample[name] for sample in samples]) for name in samples[0]}
    print(f"{'steps':>10} {'rules':>7} {'MiB':>7} {'files':>6} {'threads':>8}")
    for sample in samples[:: max(1, len(samples) // 10)] + samples[-1:]:
        print("{steps:10,} {rules:7,} {mebibytes:7.1f} {files:6} {threads:8}".format(**sample))
    for part, rows in enumerate(np.array_split(columns["mebibytes"], 4), 1):
        print(f"quarter {part}: lowest {rows.min():.0f}, highest {rows.max():.0f} MiB")
    print(f"run directory {log:.1f} MiB")
    soak.out.mkdir(parents=True, exist_ok=True)
    data = {"directory_mebibytes": log, "samples": samples}
    (soak.out / f"soak-{soak.agent}.json").write_text(json.dumps(data))
    figure, (ax,) = figures.canvas(width=5, height=3)
    ax.plot(columns["steps"] / 1e6, columns["mebibytes"], color=figures.BLUE)
    ax.set(xlabel="simulator steps [million]", ylabel="process memory [MiB] (solid)")
    ax.set_ylim(0, 1.15 * columns["mebibytes"].max())
    twin = ax.twinx()
    twin.plot(columns["steps"] / 1e6, columns["rules"], "--", color="0.6")
    twin.set(ylabel="rules (dashed)", ylim=(0, 1.3 * columns["rules"].max()))
    (soak.out / f"soak-{soak.agent}.png").write_bytes(figures.png(figure))


if __name__ == "__main__":
    main()
