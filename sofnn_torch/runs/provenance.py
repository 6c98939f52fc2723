"""Which software made a result."""

import contextlib
import platform
import subprocess
from pathlib import Path

import gymnasium
import mujoco
import numpy
import torch

import sofnn_torch


def versions() -> dict[str, str]:
    """Versions and number of threads: all that the last bits of a result depend on."""
    return {
        "sofnn_torch": sofnn_torch.__version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": numpy.__version__,
        "mujoco": mujoco.__version__,
        "gymnasium": gymnasium.__version__,
        "threads": str(torch.get_num_threads()),
        "machine": f"{platform.system()} {platform.machine()}",
    }


def commit() -> str | None:
    """Git commit of the source, with -dirty for uncommitted changes; None if not a checkout."""
    here = Path(__file__).parents[1]
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        ask = ["git", "-C", str(here), "describe", "--always", "--dirty", "--abbrev=40"]
        answer = subprocess.run(ask, capture_output=True, text=True, timeout=5)
        if answer.returncode == 0 and (here.parent / "pyproject.toml").exists():
            return answer.stdout.strip()
    return None
