"""A file that TensorBoard reads.

In contrast to torch's ``SummaryWriter`` it is written by the caller's own thread: what was added is
in the file when `flush` returns, and a disk that refuses is an `OSError` for the caller and not
the death of a thread.
"""

import os
import re
import socket
import time
from pathlib import Path

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

PREFIX = "events.out.tfevents."


class EventFile:
    """One event file in a run directory.

    Args:
        directory: the run directory.
        first_step: step of what comes next; TensorBoard drops what earlier files of the
            directory hold from this step on.

    Raises:
        OSError: the file cannot be made.
    """

    def __init__(self, directory: Path, first_step: int):
        # Files are read in the order of their names, also if the clock has been put back; seconds
        # alone would not order them.
        stamp = max(time.time(), _last_stamp(Path(directory)) + 1e-6)
        name = f"{PREFIX}{stamp:017.6f}.{socket.gethostname()}.{os.getpid()}"
        self.path = Path(directory) / name
        self._records = RecordWriter(open(self.path, "xb"))  # noqa: SIM115
        self._add(Event(file_version="brain.Event:2"), 0)
        self._add(Event(session_log=SessionLog(status=SessionLog.START)), first_step)
        self.flush()

    def add(self, summary: Summary, step: int = 0) -> None:
        """Append a summary at a step.

        Raises:
            OSError: the disk refused; the file is damaged from here on, begin another one.
        """
        self._add(Event(summary=summary), step)

    def flush(self) -> None:
        """Hand everything to the operating system.

        Raises:
            OSError: as `add`.
        """
        self._records.flush()

    def close(self) -> None:
        """Flush and close the file."""
        self._records.close()

    def _add(self, event: Event, step: int) -> None:
        event.step, event.wall_time = step, time.time()
        self._records.write(event.SerializeToString())


def _last_stamp(directory: Path) -> float:
    """The latest time in the names of the event files of a directory; 0 if there are none."""
    names = [path.name.removeprefix(PREFIX) for path in directory.glob(f"{PREFIX}*")]
    found = [re.match(r"[0-9]{1,11}(\.[0-9]{6})?", name) for name in names]
    return max((float(stamp[0]) for stamp in found if stamp), default=0.0)
