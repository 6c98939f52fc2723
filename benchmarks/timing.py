"""What the benchmarks share: interleaved timing, the machine, JSON."""

import argparse
import gc
import json
import os
import platform
import shlex
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch


def interleaved(
    functions: dict[str, Callable[[], Any]], repeats: int = 15, seconds: float = 0.02
) -> dict[str, np.ndarray]:
    """Microseconds per call of each function, in every repeat one function after the other.

    On a shared machine speed changes from second to second. Functions timed within one repeat
    share it, so take ratios within repeats, and their median.

    Args:
        functions: what to time, by name.
        repeats: how often.
        seconds: how long one function runs in one repeat, roughly.
    """
    calls = {}
    for name, function in functions.items():
        function()
        begin = time.perf_counter()
        function()
        calls[name] = max(1, round(seconds / (time.perf_counter() - begin)))
    times: dict[str, list[float]] = {name: [] for name in functions}
    gc.collect()
    gc.disable()
    try:
        for _ in range(repeats):
            for name, function in functions.items():
                begin = time.perf_counter()
                for _ in range(calls[name]):
                    function()
                times[name].append((time.perf_counter() - begin) / calls[name] * 1e6)
    finally:
        gc.enable()
    return {name: np.array(values) for name, values in times.items()}


def ratio(a: np.ndarray, b: np.ndarray) -> float:
    """Median of the ratios in each repeat."""
    return float(np.median(a / b))


def median(values: np.ndarray) -> float:
    """Median as a plain number."""
    return float(np.median(values))


def arguments(doc: str, repeats: int, flags: str = "", **paths: str) -> argparse.Namespace:
    """The options of every benchmark, paths with their help, and flags of a run if there is one."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    if flags:
        parser.add_argument("--flags", type=shlex.split, default=flags, help="flags of train.py")
    parser.add_argument("--repeats", type=int, default=repeats)
    for name, text in {"out": "JSON file to write", **paths}.items():
        parser.add_argument(f"--{name}", type=Path, help=text)
    return parser.parse_args()


def report(options: argparse.Namespace, **tables: list[dict[str, Any]]) -> None:
    """Print tables, given as lists of rows, and write them as JSON."""
    machine = {
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "mujoco": mujoco.__version__,
        "repeats": options.repeats,
    }
    print(", ".join(f"{name} {value}" for name, value in machine.items()))
    for title, rows in tables.items():
        columns = list(rows[0])
        cells = [columns, *[[_cell(row[name]) for name in columns] for row in rows]]
        sizes = [max(len(line[i]) for line in cells) for i in range(len(columns))]
        print(f"\n{title.replace('_', ' ')}")
        for first, *others in cells:
            right = [cell.rjust(size) for cell, size in zip(others, sizes[1:], strict=True)]
            print("  ".join(["", first.ljust(sizes[0]), *right]))
    if options.out:
        options.out.write_text(json.dumps({**machine, **tables}, indent=2) + "\n")


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3g}" if value < 100 else f"{value:,.0f}"
    return f"{value:,}" if isinstance(value, int) else str(value)
