"""Command lines from typed settings, with one clear line for what is wrong."""

import contextlib
import io
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import tyro
from tqdm import tqdm

# What tyro says, and how it is said here; the first that fits.
PLAIN = {
    r"Missing value for argument '(.+)'\. Expected 1 values\.": r"\1 needs a value",
    r"Missing value for argument '(.+)'\. Expected (\d+) values\.": r"\1 needs \2 values",
    r"Missing from .+?: (\S+) (.+) \(required\)": r"\1 is missing: \2",
    r"invalid choice (.+) for argument '(.+)'\. .+\((.+)\)\.": r"\2 must be one of \3, got \1",
    r"Error parsing (\S+): .+ \{None\}\|\{?(.+?)\}? could .+? from (\[.*?\])\..*": (
        r"\1 must be \2 or None, got \3"
    ),
    r"Error parsing (\S+): .+ for int\(\) .+?: (.+)": r"\1 must be a whole number, got \2",
    r"Error parsing (\S+): .+ to float: (.+)": r"\1 must be a number, got \2",
    r"Error parsing (\S+): .+? \[(.+)\] into tuple .+\[(.+)\]": r"\1 must be \3, got \2",
    r"Error parsing (\S+): Could not find valid parse .+?: (\[.*\])": r"\1 cannot be \2",
    r"Error parsing \w+: (--.+)": r"\1",  # said by a check of the settings
}


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
            return tyro.cli(kind, args=argv, prog=_program(), description=description, **settings)
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
        with output():
            action(parse(kind, sys.argv[1:], description))
    except (ValueError, OSError, RuntimeError, ArithmeticError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)


@contextlib.contextmanager
def output() -> Iterator[None]:
    """Inside, what the encoding lacks prints as ``?``, and a reader that leaves is no error."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    try:
        try:
            yield
        finally:
            print(end="", flush=True)
    except BrokenPipeError:  # whoever read has enough; Python must not try again on exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _program() -> str:
    """What was called, as the help shows it: a module, a file or an installed command."""
    module = sys.modules["__main__"].__spec__
    if module:
        return f"python -m {module.name.removesuffix('.__main__')}"
    path = sys.argv[0]
    return f"python {path}" if path.endswith(".py") else Path(path).name


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
    for said, plain in PLAIN.items():
        if found := re.fullmatch(said, what):
            return found.expand(plain)
    hint = next((m[1] for line in lines[end:] if (m := re.match(r"(--\w[\w.-]*)", line))), None)
    return f"{what}; did you mean {hint}?" if hint and "nrecognized" in what else what


def say(text: str) -> None:
    """One line on the error stream, above a progress bar if there is one."""
    tqdm.write(text, file=sys.stderr)


def plural(number: int, thing: str) -> str:
    """A number of things, as in `1 rule` and `2,000 rules`."""
    return f"{number:,} {thing}{'s' * (number != 1)}"
