"""Signals that ask a run to stop."""

import signal
import threading
from pathlib import Path
from typing import Any


class Interrupted(Exception):
    """A signal asked to stop.

    Attributes:
        number: of the signal.
        run: directory of the run, None outside one.
    """

    def __init__(self, number: int):
        super().__init__(signal.Signals(number).name)
        self.number = number
        self.run: Path | None = None


# Ctrl-C, `kill`, a terminal that is closed, and what clusters send before the time is up.
NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)


class SignalTrap:
    """Notes the signals that ask to stop instead of dying of them: the loop can stop in order.

    Outside the main thread, where Python allows no handlers, it notes nothing; a SIGHUP that is
    ignored, as under `nohup`, stays so.

    Attributes:
        number: of the last signal, 0 as long as there was none.
    """

    def __init__(self) -> None:
        self.number = 0
        self._former: dict[int, Any] = {}

    def __enter__(self) -> "SignalTrap":
        if threading.current_thread() is threading.main_thread():
            for number in NUMBERS:
                if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                    self._former[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._former.items():
            signal.signal(number, handler or signal.SIG_DFL)  # None: not of Python

    def _note(self, number: int, _frame: object) -> None:
        self.number = number
