"""Command lines from typed settings, with one clear line for what is wrong."""

import contextlib
import io
import re
import sys
from collections.abc import Callable, Sequence
from typing import Any

import tyro


def parse(kind: Any, argv: Sequence[str], description: str, default: Any = None) -> Any:
    """Settings of a class from command line arguments; the framed messages of tyro made one line.

    Args:
        kind: a dataclass; the text under a field is its help.
        argv: the arguments.
        description: shown above the flags in the help.
        default: an instance whose values the flags change.

    Raises:
        ValueError: one line on what is wrong.
        SystemExit: with code 0 after printing the help.
    """
    messages = io.StringIO()
    settings = {} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(messages):
            return tyro.cli(kind, args=argv, description=description, **settings)
    except SystemExit as stop:
        if not stop.code:
            raise
    raise ValueError(f"{_first_message(messages.getvalue())} (--help lists all flags)")


def command(action: Callable[[Any], Any], kind: Any, description: str) -> None:
    """Do an action with the settings that the command line gives; what is wrong is one line.

    Args:
        action: takes settings of the class.
        kind: the class, as for `parse`.
        description: shown above the flags in the help.

    Raises:
        SystemExit: with code 2 after an error that a user can do something about.
    """
    try:
        action(parse(kind, sys.argv[1:], description))
    except (ValueError, OSError, RuntimeError, ArithmeticError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)


def _first_message(framed: str) -> str:
    """What a framed message of tyro says first, and the flag that it thinks was meant.

    The frame is drawn with box characters, or in a terminal without them with dashes.
    """
    lines = [line.strip("│ ") for line in framed.splitlines()]
    if not lines[0].startswith("╭"):
        lines = lines[1:]  # a title without a frame
    lines = [line for line in lines if line and line[0] not in "╭╰"]
    while lines and not lines[0].strip("-─"):
        lines = lines[1:]
    end = next((i for i, line in enumerate(lines) if not line.strip("-─")), len(lines))
    what = " ".join(lines[:end])
    hint = next((m[1] for line in lines[end:] if (m := re.match(r"(--\w[\w.-]*)", line))), None)
    return f"{what}; did you mean {hint}?" if hint and "nrecognized" in what else what
