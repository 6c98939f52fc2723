"""Where runs go: their names, and how several that start at once get along."""

import contextlib
import difflib
import fcntl
import itertools
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from sofnn_torch.maze.layouts import STANDARD
from sofnn_torch.runs.settings import MAZE, Config

UNNAMED = ".new-run"  # ending of a directory that is not yet whole


def default_name(config: Config) -> str:
    """Name of a run directory, e.g. sga-sofnn-estimated-s0, or sga-sofnn-rooms-estimated-s0.

    A run that begins with rules says so, e.g. sga-sofnn-rules-estimated-s0.
    """
    task = re.sub(r"[^\w.-]+", "-", config.env)
    if config.env == MAZE:
        layout = config.maze.layout
        name = "own" if "\n" in layout else layout.replace(":", "-")
        task = config.pose if layout == STANDARD else f"{name}-{config.pose}"
    begun = "-rules" if config.rules else ""
    return f"{config.learner.name}-{config.network}{begun}-{task}-s{config.seed}"


def numbered(path: Path) -> Iterator[Path]:
    """The path, then with -2, -3 ... appended."""
    yield path
    yield from (path.with_name(f"{path.name}-{count}") for count in itertools.count(2))


def directory(path: Path, flag: str) -> Path:
    """The directory that a flag names, made if need be.

    Raises:
        ValueError: one line on why it cannot be used.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{flag} {path} cannot be used ({reason(path, error)})") from None
    return path


def reason(path: Path, error: OSError) -> str:
    """Why a directory cannot be used, in words."""
    file = next((place for place in (path, *path.parents) if place.is_file()), None)
    return f"{file} is a file" if file else str(error.strerror)


def first_free(path: Path) -> Path:
    """The path, or with -2, -3 ... appended if it exists."""
    return next(p for p in numbered(path) if not p.exists())


def reserve(path: Path) -> Path:
    """Make an empty directory, numbered if need be, that a run can take the place of."""
    path.parent.mkdir(parents=True, exist_ok=True)
    for place in numbered(path):
        with contextlib.suppress(FileExistsError):
            place.mkdir()
            return place
    raise AssertionError("numbers end")


@contextlib.contextmanager
def alone(parent: Path) -> Iterator[None]:
    """Inside, no other process makes a run in this directory; what killed ones left is removed."""
    parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(parent, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # some file systems cannot lock a directory
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            for leftover in parent.glob(f".*{UNNAMED}"):
                shutil.rmtree(leftover, ignore_errors=True)
        yield
    finally:
        os.close(descriptor)


def meant(path: Path) -> str:
    """For one who named no run: which one may be meant; empty if there is none."""
    inside = sorted(path.glob("[!.]*/config.json"), key=lambda file: file.stat().st_mtime)
    if inside:
        return f"it holds runs: take one, such as {inside[-1].parent}"
    beside = [*path.parent.glob("[!.]*/config.json"), *Path("runs").glob("[!.]*/config.json")]
    near = difflib.get_close_matches(path.name, [file.parent.name for file in beside], 1, 0.8)
    found = next((file.parent for file in beside if file.parent.name in near), None)
    return f"did you mean {found}?" if found else ""
