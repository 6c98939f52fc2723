"""What a long job shows on the error stream: how far it is, the time left, and messages."""

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeVar

from sofnn_torch.numerals import whole

T = TypeVar("T")

EVERY = 0.1  # seconds from one redraw of a bar to the next
LINES = 10  # of progress in a file at most,
APART = 5.0  # and seconds from one to the next at least
LONG = 1.0  # seconds after which a unit shows where it is
SMOOTHING = 0.1  # weight of the last unit in the time that one takes
NARROW = 10  # cells of the shortest bar
USUAL = 80  # columns where the terminal does not say


class Progress:
    """A line that is redrawn in a terminal; in a file a line at a tenth of the work.

    The time left is that of the units that remain, each as long as the recent ones, and as much
    for what happens between units as there was on average: a video now and then is neither
    forgotten nor taken for the length of every unit.

    Args:
        name: of the job.
        total: units of work.
        done: units that were done before.
        quiet: show nothing.
        clock: seconds from any point in time on.
    """

    shown: "Progress | None" = None  # the one whose line stands in the terminal

    def __init__(
        self,
        name: str,
        total: int,
        done: int = 0,
        quiet: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.name, self.total, self.done, self.quiet, self.clock = name, total, done, quiet, clock
        self.facts: Sequence[str] = ()
        self.inside = ""
        self.begin = self.last = clock()
        self.drawn, self.noted = self.begin - EVERY, self.begin
        self.units, self.own, self.recent = 0, 0.0, 0.0
        self._show()

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the line as it is at the end."""
        if Progress.shown is self:
            _write(f"{self._padded()}\n")
            Progress.shown = None

    def update(
        self, units: int = 1, seconds: float | None = None, facts: Sequence[str] | None = None
    ) -> None:
        """Note that work is done.

        Args:
            units: of work, since the last call.
            seconds: that they took themselves; None for all the time since the last ones.
            facts: shown behind the time left, the most important first.
        """
        if facts is not None:
            self.facts = facts
        if units:
            self.inside = ""
            now, tenth = self.clock(), LINES * self.done // max(self.total, 1)
            each = (now - self.last if seconds is None else seconds) / units
            weight = SMOOTHING if self.units else 1.0
            self.recent += weight * (each - self.recent)
            self.own += each * units
            self.units, self.done, self.last = self.units + units, self.done + units, now
            if LINES * self.done // max(self.total, 1) > tenth:
                self._note(now)
        self._show()

    def within(self, fact: str) -> None:
        """Note how far a long unit of work is, shown before the other facts until it is done."""
        if self.clock() - self.last > LONG:
            self.inside = fact
            self._show()

    def through(self, things: Iterable[T]) -> Iterator[T]:
        """The things, each a unit of work that is done when it comes."""
        for thing in things:
            self.update()
            yield thing

    def print(self, text: str) -> None:
        """Print a line of the results above."""
        if Progress.shown is self:
            _write(f"\r{'':{columns() - 1}}\r")
        print(text, flush=True)
        self.drawn -= EVERY
        self._show()

    def left(self) -> float | None:
        """Seconds that the rest will take; None before the first unit."""
        if not self.units:
            return None
        between = max(0.0, self.last - self.begin - self.own) / self.units
        return (self.total - self.done) * (self.recent + between)

    def line(self, width: int) -> str:
        """The line for a terminal of so many columns.

        Bar and name, which the user has just given, go before a fact does; time left and first
        fact stay longest.
        """
        name, facts = f"{self.name} ", [*filter(None, [self.inside]), *self.facts]
        percent = f"{100 * self.done // max(self.total, 1):3d}%"
        for kept in range(len(facts), 0, -1):
            text = self._numbers(facts[:kept])
            room = width - len(f"{name}{percent}|| {text}")
            if room >= NARROW:
                filled = room * self.done // max(self.total, 1)
                return f"{name}{percent}|{'#' * filled:-<{room}}| {text}"
            if len(line := f"{percent} {text}") <= width:
                return line
        text = self._numbers(facts[:1])
        return next(
            (line for line in (f"{name}{percent} {text}", text) if len(line) <= width), text[:width]
        )

    def _numbers(self, facts: Sequence[str]) -> str:
        left = self.left()
        time_left = "?" if left is None else duration(left)
        times = f"{duration(self.clock() - self.begin)}<{time_left}"
        return f"{self.done}/{self.total} [{', '.join([times, *facts])}]"

    def _padded(self) -> str:
        width = columns() - 1  # a full line would break
        return f"\r{self.line(width):<{width}}"

    def _note(self, now: float) -> None:
        if not self.quiet and not _is_terminal() and now - self.noted >= APART:
            self.noted = now
            _write(f"{self.name} {self._numbers(self.facts)}\n")

    def _show(self) -> None:
        now = self.clock()
        if self.quiet or not _is_terminal() or now - self.drawn < EVERY:
            return
        self.drawn, Progress.shown = now, self
        _write(self._padded())


def say(text: str) -> None:
    """One line on the error stream, above the progress if there is one."""
    bar = Progress.shown
    _write(f"\r{'':{columns() - 1}}\r{text}\n" if bar else f"{text}\n")
    if bar:
        _write(bar._padded())


def columns() -> int:
    """Columns of the terminal, as the user or the terminal says."""
    with contextlib.suppress(ValueError):
        if (width := whole(os.environ.get("COLUMNS", ""))) > 0:
            return width
    with contextlib.suppress(OSError, ValueError, AttributeError):
        if (width := os.get_terminal_size(sys.stderr.fileno()).columns) > 0:
            return width
    return USUAL


def duration(seconds: float) -> str:
    """Minutes and seconds, as in `2:05`, or hours too, as in `1:02:05`."""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _is_terminal() -> bool:
    with contextlib.suppress(ValueError, AttributeError):  # closed, or there is none
        return sys.stderr.isatty()
    return False


def _write(text: str) -> None:
    with contextlib.suppress(OSError, ValueError, AttributeError):
        sys.stderr.write(text)
        sys.stderr.flush()
