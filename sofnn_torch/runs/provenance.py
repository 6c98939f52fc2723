"""Which software and which processor made a result, and how to make the latter not matter."""

import ast
import contextlib
import functools
import hashlib
import os
import platform
import re
import subprocess
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy
import torch

import sofnn_torch
from sofnn_torch.maze.layouts import assets

# Torch and MKL choose their instructions by the processor, and sum in another order with each.
# AVX2 for torch's own kernels, and the branch of MKL that is the same on all makes of processors.
PORTABLE = {"ATEN_CPU_CAPABILITY": "avx2", "MKL_CBWR": "COMPATIBLE"}
# What decides, beside settings and versions, what is learned and how it is played.
DECIDING = (
    "network learners tasks maze training.py evaluate.py runs/trial.py runs/seeding.py "
    "runs/factory.py"
).split()
SHOWING = ("optimum.py", "rendering.py", "viewer.py")  # of the maze


def versions() -> dict[str, str]:
    """Versions, processor and arithmetic: all that the last bits of a result depend on."""
    flushed = bool(torch.tensor(1e-30) * 1e-10 == 0)
    return {
        "sofnn_torch": sofnn_torch.__version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": numpy.__version__,
        "mujoco": mujoco.__version__,
        "gymnasium": gymnasium.__version__,
        "threads": str(torch.get_num_threads()),
        "machine": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "instructions": torch.backends.cpu.get_cpu_capability(),
        "blas": _blas(),
        "denormals": "flushed" if flushed else "kept",
    }


@functools.cache
def _processor() -> str:
    """Name of the processor; MKL also goes by its make."""
    with contextlib.suppress(OSError):
        text = Path("/proc/cpuinfo").read_text()
        if found := re.search(r"model name\s*: (.+)", text):
            return found[1].strip()
    return platform.processor() or "unknown"


@functools.cache
def _blas() -> str:
    """Library of matrix products, and its branch if one was asked for."""
    text = torch.__config__.show()
    if found := re.search(r"Math Kernel Library Version (\S+)", text):
        branch = os.environ.get("MKL_CBWR")
        return f"MKL {found[1]}" + f", {branch}" * bool(branch)
    found = re.search(r"BLAS_INFO=(\w+)", text)
    return found[1] if found else "unknown"


def make_portable() -> None:
    """From now on compute what any x86-64 processor with AVX2 would, to the last bit.

    Raises:
        ValueError: this processor has no AVX2, or torch has computed something already.
    """
    if not getattr(torch.cpu, "_is_avx2_supported", lambda: True)():
        raise ValueError("--portable needs a processor with AVX2 instructions")
    os.environ.update(PORTABLE)  # both libraries read it when they compute for the first time
    if torch.backends.cpu.get_cpu_capability() != "AVX2":
        words = " ".join(f"{name}={value}" for name, value in PORTABLE.items())
        raise ValueError(f"torch has computed already: start with {words} in the environment")


def commit() -> str | None:
    """Git commit of the source, with -dirty for uncommitted changes; None if not a checkout."""
    here = Path(__file__).parents[1]
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        ask = ["git", "-C", str(here), "describe", "--always", "--dirty", "--abbrev=40"]
        answer = subprocess.run(ask, capture_output=True, text=True, timeout=5)
        if answer.returncode == 0 and (here.parent / "pyproject.toml").exists():
            return answer.stdout.strip()
    return None


def record() -> dict[str, Any]:
    """What config.json holds of all that makes a result."""
    return {"versions": versions(), "commit": commit(), "code": code()}


@functools.cache
def code() -> str:
    """Fingerprint of the source that decides what is learned; comments and docstrings are none.

    Runs of equal fingerprint, settings and seed are equal but for what `versions` holds.
    """
    here = Path(__file__).parents[1]
    sources = [here / name for name in DECIDING if name.endswith(".py")]
    sources += [f for name in DECIDING for f in (here / name).glob("*.py") if f.name not in SHOWING]
    digest = hashlib.sha256()
    for file in sorted(sources):
        digest.update(_bare(file.read_text()).encode())
    for file in sorted([*assets().glob("*.xml"), *assets().glob("mazes/*.txt")]):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def _bare(source: str) -> str:
    """Source without comments and docstrings, in a layout of Python's own."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            kept = [n for n in body if not (isinstance(n, ast.Expr) and _is_text(n.value))]
            node.body = kept or [ast.Pass()]  # type: ignore[attr-defined]
    return ast.unparse(tree)


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)
