"""One run, one directory: settings, trial table, checkpoints, and a lock against a second process.

Everything that a run must not lose goes through `Run`. Its memory is the truth and the directory
a copy: when the directory vanishes or the disk is full, training goes on, and every later trial
tries again to write all that is missing (docs/checkpoints.md).
"""

import contextlib
import dataclasses
import errno
import itertools
import json
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import filelock

from sofnn_torch.progress import say
from sofnn_torch.runs import checkpoint, table
from sofnn_torch.runs.checkpoint import CheckpointError
from sofnn_torch.runs.places import UNNAMED, alone, first_free, meant, reason
from sofnn_torch.runs.provenance import record
from sofnn_torch.runs.settings import Config, from_dict
from sofnn_torch.terminal import quoted

LARGEST_SETTINGS = 2**20  # bytes


class Run:
    """The directory of one run, held by this process until `close`.

    Attributes:
        path: the directory.
        config: the settings of the run.
        saved: trial of the newest checkpoint on the disk; None if it is missing there.
    """

    def __init__(self, path: Path, config: Config, keep: int):
        self.path, self.config, self.keep = path, config, keep
        self.rows: list[str] = []  # lines of trials.csv, the header first
        self.table_size = 0  # bytes of trials.csv known to be written
        self.saved: int | None = None
        self._warned: set[str] = set()
        self.earlier: list[Any] = []  # versions and commits of earlier sessions
        self._lock: filelock.BaseFileLock | None = None
        self._anchor: int | None = None

    @classmethod
    @contextlib.contextmanager
    def create(
        cls, places: Iterable[Path], config: Config, keep: int, earlier: Sequence[Any] = ()
    ) -> "Iterator[Run]":
        """Make a new directory, which is filled inside the block and appears whole at its end.

        Args:
            places: where it may be; the first that is free, or an empty directory, is taken.
            config: the settings.
            keep: checkpoints that are kept.
            earlier: versions and commits of the sessions that it comes from.

        Yields:
            The run, under a hidden name; of a block that fails nothing is left.

        Raises:
            ValueError: all places are taken or the directory cannot be written.
        """
        places = iter(places)
        path = next(places)
        try:
            with alone(path.parent):
                hidden = path.with_name(f".{secrets.token_hex(8)}{UNNAMED}")
                run = cls(hidden, config, keep)
                run.earlier = list(earlier)
                try:
                    run.path.mkdir()
                    run._write_settings()
                    yield run
                    run._appear(itertools.chain([path], places))
                except BaseException:
                    shutil.rmtree(hidden, ignore_errors=True)
                    raise
        except OSError as error:
            raise ValueError(f"{path} cannot be used ({reason(path, error)})") from None

    @classmethod
    def open(cls, path: Path, config: Config, keep: int) -> "Run":
        """Take the directory of an existing run to go on with it; nothing in it changes.

        Raises:
            ValueError: another process works on it or it cannot be written.
        """
        run = cls(path, config, keep)
        try:
            run._acquire()
        except OSError as error:
            raise ValueError(f"{path} cannot be used ({reason(path, error)})") from None
        return run

    def begin(self, state: dict[str, Any]) -> None:
        """Write the first checkpoint of a new run.

        Raises:
            OSError: the directory refuses it.
        """
        checkpoint.save(self.path / f"checkpoint-{state['trial']}.pt", state)
        self.saved = state["trial"]

    def rewind(self, state: dict[str, Any]) -> None:
        """Go back to a state: cut the trial table to its trials, set newer checkpoints aside.

        Raises:
            ValueError: the directory cannot be written.
        """
        file, trial = self.path / "trials.csv", state["trial"]
        try:
            # First, so that there is a checkpoint to go on from whatever happens next.
            self.begin(state)
            for leftover in self.path.glob(".*.tmp"):
                leftover.unlink()
            newer = [p for p in checkpoint.checkpoints(self.path) if checkpoint.number(p) > trial]
            for path in [*newer, file] if newer else []:
                with contextlib.suppress(FileNotFoundError):
                    shutil.copyfile(path, path.with_name(f"{path.name}.unused"))
            self.rows = table.take(file, trial, max(trial, self.config.trials))
            self._write_table()
            self._note_versions()
            self._write_settings()
            for path in newer:
                path.unlink()
        except OSError as error:
            raise ValueError(f"{self.path} cannot be written ({error.strerror})") from None

    def record(self, row: dict[str, Any]) -> None:
        """Add the line of a trial to trials.csv; floats are written to their last bit."""
        if not self.rows:
            self.rows.append(table.line(row))
        columns = self.rows[0].strip().split(",")
        self.rows.append(table.line([row.get(column, "") for column in columns]))
        with self._forgiving("trials.csv"):
            if self._table_is_whole():
                size, self.table_size = self.table_size, 0  # unknown if the next lines fail
                with open(self.path / "trials.csv", "a", newline="") as file:
                    file.write(self.rows[-1])
                self.table_size = size + len(self.rows[-1].encode())
            else:
                self._write_table()

    def save(self, state: dict[str, Any]) -> bool:
        """Write checkpoint-<trial>.pt and drop the oldest; True if it is on the disk."""
        self.saved = None
        with self._forgiving("the checkpoint"):
            if self._table_is_whole():  # it must not be behind the checkpoint after a power cut
                with open(self.path / "trials.csv", "rb") as file:
                    os.fsync(file.fileno())
            else:
                self._write_table()
            checkpoint.save(self.path / f"checkpoint-{state['trial']}.pt", state)
            self.saved = state["trial"]
        with contextlib.suppress(OSError):  # the next save drops them
            for old in checkpoint.checkpoints(self.path)[self.keep :]:
                old.unlink(missing_ok=True)
        return self.saved is not None

    def save_as(self, name: str, state: dict[str, Any]) -> None:
        """Write another file in the format of a checkpoint: the best one, a divergence."""
        with self._forgiving(name):
            checkpoint.save(self.path / name, state)

    def rescue(self, state: dict[str, Any]) -> Path:
        """Save a state outside the run directory, which refuses it; where.

        Raises:
            OSError: every other place refused it too.
        """
        name = f"{self.path.name}-checkpoint-{state['trial']}.pt"
        for place in (tempfile.gettempdir(), Path.cwd(), Path.home()):
            with contextlib.suppress(OSError):
                path = Path(tempfile.mkdtemp(prefix="sofnn-rescue-", dir=place)) / name
                checkpoint.save(path, state)
                return path
        raise OSError(f"trial {state['trial']} could not be saved anywhere")

    def warn(self, topic: str, text: str) -> None:
        """Say a warning, once for each topic."""
        if topic not in self._warned:
            self._warned.add(topic)
            say(f"warning: {text}")

    def close(self) -> None:
        """Give the directory back."""
        if self._lock is not None:
            self._lock.release()
        if self._anchor is not None:
            os.close(self._anchor)
            self._anchor = None

    @contextlib.contextmanager
    def _forgiving(self, what: str) -> Iterator[None]:
        """Training outlives a disk that refuses: warn once, the next trial tries again."""
        try:
            if not self._is_ours():
                self._remake()
            yield
            self._warned.discard(what)
        except OSError as error:
            reason = error.strerror or str(error)
            self.warn(what, f"{what} cannot be written to {self.path} ({reason}); will try again")

    def _appear(self, places: Iterable[Path]) -> None:
        """Move to the first place that is free; what is whole appears at once."""
        for path in places:
            try:
                self.path = self.path.rename(path)
            except OSError as error:
                if error.errno not in (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR):
                    raise
            else:
                checkpoint.sync_directory(path.parent)
                self._acquire()
                return
        raise ValueError(
            f"{path} exists: choose another --name, or go on with --resume {quoted(path)}"
        )

    def _is_ours(self) -> bool:
        """The directory is still the one that this process took, not a later one of that name."""
        if self._anchor is None:
            return False
        try:
            lock, settings = os.stat(self.path / "run.lock"), self.path / "config.json"
            return os.path.samestat(lock, os.fstat(self._anchor)) and settings.exists()
        except OSError:
            return False

    def _remake(self) -> None:
        """Make a deleted directory anew and write what is known by heart."""
        gone = self.path
        self.close()
        self.table_size, self.saved = 0, None
        if (gone / "config.json").exists():  # another run took the name
            self.path = first_free(gone)
        self.path.mkdir(parents=True, exist_ok=True)
        self._acquire()
        self._write_settings()
        say(f"warning: {gone} was deleted; training goes on in {self.path}, made anew")

    def _acquire(self) -> None:
        self._lock = filelock.FileLock(self.path / "run.lock", timeout=0)
        try:
            self._lock.acquire()
        except filelock.Timeout:
            raise BlockingIOError(errno.EAGAIN, "another process works on it") from None
        # An open file keeps its identity, so that a new directory of the same name is noticed.
        self._anchor = os.open(self.path / "run.lock", os.O_RDONLY)

    def _note_versions(self) -> None:
        """Keep the versions of the session before; say so where results may differ."""
        try:
            before = json.loads((self.path / "config.json").read_bytes())
            former = {"versions": before["versions"], "commit": before["commit"]}
            former["code"] = before.get("code")  # older runs have none
        except (OSError, ValueError, KeyError, TypeError):
            return
        self.earlier = before.get("earlier", [])
        now = record()
        if former == now:
            return
        self.earlier.append(former)
        then = former["versions"]
        others = [
            f"{name} was {then.get(name, 'unknown')}, is {version}"
            for name, version in now["versions"].items()
            if then.get(name) != version
        ]
        if others:
            say(f"warning: {'; '.join(others)}: numbers may differ in the last bits")

    def _write_settings(self) -> None:
        text = json.dumps(
            {"config": dataclasses.asdict(self.config), **record(), "earlier": self.earlier},
            indent=2,
        )
        checkpoint.write_atomically(self.path / "config.json", f"{text}\n".encode())

    def _table_is_whole(self) -> bool:
        file = self.path / "trials.csv"
        return self.table_size > 0 and file.exists() and file.stat().st_size == self.table_size

    def _write_table(self) -> None:
        if not self.rows:
            return
        data = "".join(self.rows).encode()
        self.table_size = 0
        checkpoint.write_atomically(self.path / "trials.csv", data)
        self.table_size = len(data)


def load_config(path: Path) -> Config:
    """The settings of the run in a directory.

    Raises:
        ValueError: not a run, or settings that this version does not know.
    """
    file = Path(path) / "config.json"
    try:
        data = json.loads(checkpoint.read_file(file, LARGEST_SETTINGS))
        return from_dict(data["config"])
    except OSError as error:
        hint = meant(Path(path)) or f"config.json: {error.strerror}"
        raise ValueError(f"{path}: not a run directory ({hint})") from None
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError, KeyError, TypeError):
        raise ValueError(f"{file}: not the settings of a run") from None
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None


def same_settings(path: Path, state: dict[str, Any], config: Config) -> None:
    """Check that a checkpoint was made with the settings of the run; trials may differ.

    Raises:
        CheckpointError: naming the first setting that differs.
    """
    try:  # settings that an older version did not have are those that it meant
        read = dataclasses.asdict(from_dict(state["config"]))
    except ValueError as error:
        raise CheckpointError(f"{path}: {error}") from None
    theirs, ours = flatten(read), flatten(dataclasses.asdict(config))
    for name in sorted(theirs.keys() | ours.keys(), key=str):
        a, b = theirs.get(name), ours.get(name)
        if a != b and name != "trials":
            raise CheckpointError(
                f"{path}: of a run with other settings ({name} {brief(a)}, here {brief(b)})"
            )


def brief(value: Any) -> str:
    """A setting in one short line; of a text its beginning and its length."""
    text = " ".join(str(value).split())
    return text if len(text) <= 60 else f"{text[:40]}... ({len(str(value))} characters)"


def flatten(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as one dictionary with dotted names; tuples as lists."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, dict):
            flat |= flatten(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = list(value) if isinstance(value, tuple) else value
    return flat
