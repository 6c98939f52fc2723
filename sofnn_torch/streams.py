"""Standard output and error for work that must not end when nobody reads."""

import contextlib
import errno
import io
import os
import select
import sys
from collections.abc import Iterator
from typing import Any

PATIENCE = 0.2  # seconds until a message that nobody reads is dropped


@contextlib.contextmanager
def output() -> Iterator[list[OSError]]:
    """Inside, nothing that becomes of the standard streams ends the work.

    A reader that leaves is no error, messages to one that does not read are dropped after a
    while, missing streams lead nowhere, and what the encoding lacks prints as ``?``.

    Yields:
        The errors of standard output by which results were lost; complete after the block.
    """
    former = (sys.stdout, sys.stderr)
    refused: list[OSError] = []
    sys.stdout = _lasting(sys.stdout, 1, None, refused)
    sys.stderr = _lasting(sys.stderr, 2, PATIENCE, [])
    try:
        yield refused
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        sys.stdout, sys.stderr = former


class _Descriptor(io.RawIOBase):
    """A standard stream that is written to as long as that works, and swallows the rest.

    Args:
        number: the file descriptor.
        patience: seconds to wait for a reader that does not read; None for ever.
        refused: takes the first error, unless the reader left.
    """

    def __init__(self, number: int, patience: float | None, refused: list[OSError]):
        self.number, self.patience, self.refused, self.open = number, patience, refused, True

    def fileno(self) -> int:
        return self.number

    def isatty(self) -> bool:
        return os.isatty(self.number)

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        try:
            if not self.open or not select.select([], [self.number], [], self.patience)[1]:
                return len(data)
            return os.write(self.number, data[: select.PIPE_BUF])  # more could block
        except BlockingIOError:  # another process took the place
            return 0
        except OSError as error:
            self.open = False
            if error.errno != errno.EPIPE:
                self.refused.append(error)
            return len(data)


def _lasting(stream: Any, number: int, patience: float | None, refused: list[OSError]) -> Any:
    """A stream for one of Python's own; streams of other kinds, as of notebooks, stay."""
    if stream is None or getattr(stream, "closed", False):
        _occupy(number)
        descriptor, encoding = _Descriptor(number, patience, refused), "utf-8"
        descriptor.open = False
    else:
        try:
            stream.reconfigure(errors="replace")
            raw = getattr(stream.buffer, "raw", stream.buffer)  # itself with python -u
            if not isinstance(raw, io.FileIO):
                return stream
            with contextlib.suppress(OSError):  # it is full already
                stream.flush()
            descriptor = _Descriptor(stream.fileno(), patience, refused)
        except AttributeError:  # of another kind
            return stream
        encoding = stream.encoding
    buffer = io.BufferedWriter(descriptor)
    return io.TextIOWrapper(buffer, encoding, "replace", line_buffering=True)


def _occupy(number: int) -> None:
    """Take a descriptor that is closed, so that no file gets it and with it foreign messages."""
    try:
        os.fstat(number)
    except OSError:
        free = os.open(os.devnull, os.O_RDWR)
        if free != number:
            os.dup2(free, number)
            os.close(free)
