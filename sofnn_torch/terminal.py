"""Command lines from typed settings, with one clear line for what is wrong."""

import contextlib
import dataclasses
import io
import re
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from sofnn_torch import help, numerals
from sofnn_torch.progress import say
from sofnn_torch.runs.signals import Interrupted
from sofnn_torch.streams import output

__all__ = ["attempt", "check_output", "command", "parse", "plural", "program", "quoted", "say"]

# Exit codes by what went wrong, the first that fits.
FAILURES = dict.fromkeys((ValueError, OSError, RuntimeError, ArithmeticError), 2)

# What tyro says, and how it is said here; the first that fits.
PLAIN = {
    r"Missing value for argument '(.+)'\. Expected 1 values\.": r"\1 needs a value",
    r"Missing value for argument '(.+)'\. Expected (\d+) values\.": r"\1 needs \2 values",
    r"Missing from .+?: (--\S+) (?:\[.+?\]\]|\S+) (.+) \(required\)": r"\1 is missing: \2",
    r"Missing from .+?: (\S+) (.+) \(required\)": r"\1 is missing: \2",
    r"invalid choice (.+) for argument '(.+)'\. .+\((.+)\)\.": r"\2 must be one of \3, got \1",
    r"Error parsing (\S+): (must be .+)": r"\1 \2",
    r"Error parsing (\S+): Could not find valid parse .+?: (.+)": r"\1 cannot be \2",
    r"Error parsing (\S+): .+? \[(.+)\] into tuple .+\[(.+)\]": r"\1 must be \3, got \2",
    r"Error parsing [\w.]+: (.+)": r"\1",  # said by a check of the settings
}
# Values that are none of their flag, whose kind stands in the help below.
WRONG = re.compile(
    r"Error parsing (--\S+): (?:Could not find valid parse .+?: |no type matching .+? from )"
    r"\[(.*?)\](?:\. .*)?"
)
KINDS = {
    "[INT [INT ...]]": "whole numbers",
    "[FLOAT [FLOAT ...]]": "numbers",
    "INT": "a whole number",
    "FLOAT": "a number",
}

TYPES = ConstructorRegistry()


@TYPES.primitive_rule
def _plain_number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """How tyro reads ``int`` and ``float``: as in a file, only plain numbers are numbers."""
    if info.type not in (int, float):
        return None
    read = numerals.whole if info.type is int else numerals.decimal
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=info.type.__name__.upper(),
        instance_from_str=lambda words: read(words[0]),
        is_instance=lambda value: type(value) in (int, info.type),
        str_from_instance=lambda value: [str(value)],
    )


def parse(
    kind: Any,
    argv: Sequence[str],
    description: str,
    default: Any = None,
    first: Collection[str] = (),
) -> Any:
    """Settings of a class from command line arguments; the framed messages of tyro made one line.

    Args:
        kind: a dataclass; the text under a field is its help.
        argv: the arguments.
        description: shown above the flags in the help.
        default: an instance whose values the flags change.
        first: the flags that --help shows, if --help-all is to show the others.

    Raises:
        ValueError: one line on what is wrong.
        SystemExit: with code 0 after printing the help.
    """
    asked = {"-h", "--help", *(["--help-all"] if first else [])} & set(argv)
    if asked:
        whole = not first or "--help-all" in asked
        print(help.text(kind, program(), description, default, first, whole))
        raise SystemExit(0)
    messages = io.StringIO()
    settings = {} if default is None else {"default": default}
    try:
        with TYPES, contextlib.redirect_stderr(messages):
            given = tyro.cli(kind, args=argv, prog=program(), description=description, **settings)
        _refuse_flags_as_values(dataclasses.asdict(given), argv)
        return given
    except SystemExit as stop:
        if not stop.code:
            raise
    flags = "--help-all" if first else "--help"
    raise ValueError(f"{_first_message(messages.getvalue())} ({flags} lists all flags)")


def command(action: Callable[[Any], Any], kind: Any, description: str, advice: str = "") -> None:
    """Do an action with the settings that the command line gives, and end the process.

    Args:
        action: takes settings of the class; may return an exit code.
        kind: the class, as for `parse`.
        description: shown above the flags in the help.
        advice: how to go on after a stop.

    Raises:
        SystemExit: always, with the exit code of `attempt`.
    """

    def work() -> int:
        code = action(parse(kind, sys.argv[1:], description))
        return code if isinstance(code, int) else 0

    sys.exit(attempt(work, advice=advice))


def attempt(
    work: Callable[[], int], failures: Mapping[type[Exception], int] = FAILURES, advice: str = ""
) -> int:
    """Do the work of a command; its exit code. What is wrong is one line.

    Args:
        work: the work; returns an exit code.
        failures: exit codes of the errors that a user can do something about.
        advice: how to go on after a stop, where it does not come with the stop itself.

    Returns:
        The code of the work or of its failure; 128 and the number of the signal that stopped it.
    """
    with output() as refused, _warnings_in_a_line():
        try:
            with _keyboard_interrupts():
                code = work()
        except tuple(failures) as error:
            say(f"error: {' '.join(str(error).split())}")
            code = next(c for kind, c in failures.items() if isinstance(error, kind))
        except Interrupted as stop:
            go_on = f"go on with: {program()} --resume {quoted(stop.run)}" if stop.run else advice
            say(f"stopped and saved; {go_on}" if go_on else "stopped")
            code = 128 + stop.number
        except KeyboardInterrupt:
            say("stopped")
            code = 128 + signal.SIGINT
    if refused and not code:
        say(f"error: the output cannot be written ({refused[0].strerror})")
        return 1
    return code


@contextlib.contextmanager
def _warnings_in_a_line() -> Iterator[None]:
    """Inside, what libraries warn of is a line as our own; as it is where Python's -W is given."""

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        text = " ".join(re.sub(r"\x1b\[[0-9;]*m", "", str(message)).split())
        say(f"warning: {text.removeprefix('WARN: ')}")

    with warnings.catch_warnings():
        if not sys.warnoptions:
            warnings.showwarning = show
        yield


@contextlib.contextmanager
def _keyboard_interrupts() -> Iterator[None]:
    """Inside, Ctrl-C is a `KeyboardInterrupt`, also where it ended the process until now."""
    here = threading.current_thread() is threading.main_thread()
    former = signal.getsignal(signal.SIGINT)
    if not here or former != signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, former)


def program(name: str | None = None) -> str:
    """What was called, as one can call it again: a module, a file or an installed command.

    Args:
        name: of another command of this package, such as ``evaluate`` or ``train``; None for the
            same.
    """
    python = shlex.quote(sys.orig_argv[0] if sys.orig_argv else "python")
    module, path = sys.modules["__main__"].__spec__, sys.argv[0]
    installed = Path(path).name
    if name and module is None and installed.startswith("sofnn-"):
        return f"sofnn-{name}"
    if name == "train":
        return f"{python} {'train.py' if Path('train.py').is_file() else '-m sofnn_torch.cli'}"
    if name:
        return f"{python} -m sofnn_torch.{name}"
    if module:
        return f"{python} -m {module.name.removesuffix('.__main__')}"
    return f"{python} {quoted(path)}" if path.endswith(".py") else installed


def quoted(path: Path | str) -> str:
    """A path for a command line that can be pasted into a shell."""
    text = str(path)
    return shlex.quote(f"./{text}" if text.startswith("-") else text)


def check_output(flag: str, path: Path | None, endings: Sequence[str] = ()) -> None:
    """Check that a file, if one is asked for, can be written, before work is done for it.

    Args:
        flag: that names the file.
        path: of the file.
        endings: that it may have, in any case; empty for any.

    Raises:
        ValueError: it has another ending, or is no file in an existing directory.
    """
    if path and endings and path.suffix.lower() not in endings:
        raise ValueError(f"{flag} must end in {' or '.join(endings)}, got {path}")
    if path and (path.is_dir() or not path.parent.is_dir()):
        raise ValueError(f"{flag} {path}: not a file in an existing directory")


def _refuse_flags_as_values(settings: dict[str, Any], argv: Sequence[str]) -> None:
    """Raise ValueError on text or a path that looks like a flag: its value was forgotten."""
    for name, value in settings.items():
        if isinstance(value, dict):
            _refuse_flags_as_values(value, argv)
        elif isinstance(value, str | Path) and str(value).startswith("-"):
            flag = f"--{name}".replace("_", "-")
            if str(value) in argv or f"{flag}={value}" in argv:  # ./-x is a path as any other
                raise ValueError(f"{flag} needs a value, and {value} looks like a flag")


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
    if found := WRONG.fullmatch(what):
        flag, given = found[1], " ".join(re.findall(r"""['"](.*?)['"](?:, |$)""", found[2]))
        return f"{flag} must be {_kind(flag, lines[end:])}, got '{given}'"
    for said, plain in PLAIN.items():
        if found := re.fullmatch(said, what):
            return found.expand(plain)
    hint = next((m[1] for line in lines[end:] if (m := re.match(r"(--\w[\w.-]*)", line))), None)
    return f"{what}; did you mean {hint}?" if hint and "nrecognized" in what else what


def _kind(flag: str, lines: Sequence[str]) -> str:
    """What a flag takes, from tyro's help on it."""
    shown = next(line for line in lines if line.startswith(f"{flag} ")).removeprefix(f"{flag} ")
    kind = shown.removeprefix("{None}|")
    if kind.startswith("{") and kind.endswith("}"):
        kind = kind[1:-1]
    return KINDS.get(kind, kind) + " or None" * (kind != shown)


def plural(number: int, thing: str) -> str:
    """A number of things, as in `1 rule` and `2,000 rules`."""
    return f"{number:,} {thing}{'s' * (number != 1)}"
