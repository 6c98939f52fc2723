"""The help of a command from its settings class: groups, wrapped to the width of the terminal."""

import ast
import dataclasses
import inspect
import itertools
import shutil
import textwrap
import types
import typing
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import tyro

KINDS = {int: "INT", float: "NUMBER", str: "TEXT", Path: "PATH"}
NARROWEST, WIDEST = 40, 200  # columns
INDENT = 22  # columns of a flag before its text


class Flag(NamedTuple):
    """One flag or argument."""

    group: str
    """What its part of the settings is called; empty for those of the command itself."""
    name: str
    """As its values are set, as in `net.width-heading`."""
    usage: str
    """As it is given, as in `--net.width-heading NUMBER`."""
    text: str
    """What it does, in one line."""
    positional: bool


def text(
    kind: Any,
    call: str,
    description: str,
    default: Any = None,
    first: Collection[str] = (),
    whole: bool = True,
) -> str:
    """The help of a command.

    Args:
        kind: the settings class, as for `terminal.parse`.
        call: how the command is called.
        description: shown above the flags; indented lines stay lines of their own.
        default: an instance whose values are the defaults.
        first: names of the flags that matter most, if there is a short help of them.
        whole: all flags, in groups; otherwise the first.
    """
    width = min(max(shutil.get_terminal_size().columns, NARROWEST), WIDEST)
    flags = sorted(_flags(kind, default), key=lambda flag: flag.group != "")
    arguments = " ".join(flag.usage for flag in flags if flag.positional)
    lines = [f"usage: {call} [OPTIONS] {arguments}".rstrip(), ""]
    for line in description.strip().splitlines():
        after = " " * (len(line) - len(line.lstrip()) + 4 if line.startswith(" ") else 0)
        lines += textwrap.wrap(line, width, subsequent_indent=after) or [""]
    helps = [("-h, --help", "the flags that matter most" if first else "this help")]
    helps += [("--help-all", "all flags, in groups")] if first else []
    lines += ["", "options:", *(line for entry in helps for line in _entry(*entry, width))]
    group = ""
    for flag in flags:
        if whole and flag.group != group:
            group = flag.group
            lines += ["", *textwrap.wrap(f"{group}:", width)]
        if whole or flag.name in first:
            lines += _entry(flag.usage, flag.text, width)
    return "\n".join(lines)


def _entry(usage: str, what: str, width: int) -> list[str]:
    """A flag and its text, beside each other or below."""
    margin = " " * min(INDENT + 2, width // 3)
    head = f"  {usage}"
    lines = textwrap.wrap(what, width, initial_indent=margin, subsequent_indent=margin)
    if lines and len(head) < len(margin) - 1:
        return [head.ljust(len(margin)) + lines[0].lstrip(), *lines[1:]]
    return [*textwrap.wrap(head, width, subsequent_indent=margin), *lines]


def _flags(kind: Any, default: Any, prefix: str = "", group: str = "") -> Iterator[Flag]:
    """Those of a settings class, first its own, then those of its parts."""
    hints, texts = typing.get_type_hints(kind, include_extras=True), _texts(kind)
    parts = []
    for field in dataclasses.fields(kind):
        hint, extras = _bare(hints[field.name])
        value = field.default if default is None else getattr(default, field.name)
        if dataclasses.is_dataclass(hint):
            parts.append((hint, value, field.name, extras))
            continue
        yield _flag(prefix + field.name.replace("_", "-"), hint, extras, value, texts, group)
    for part, value, name, extras in parts:
        value = value if dataclasses.is_dataclass(value) else None
        if any(getattr(extra, "name", None) == "" for extra in extras):
            yield from _flags(part, value, prefix, group)
        else:
            title = inspect.getdoc(part) or name
            yield from _flags(
                part, value, f"{prefix}{name}.", title.partition("\n\n")[0].rstrip(".")
            )


def _flag(
    name: str, hint: Any, extras: tuple[Any, ...], value: Any, texts: dict[str, str], group: str
) -> Flag:
    args = [extra for extra in extras if hasattr(extra, "metavar")]
    metavar = next((arg.metavar for arg in args if arg.metavar), None) or _metavar(hint)
    aliases = [alias for arg in args for alias in arg.aliases or ()]
    what = texts.get(name.rpartition(".")[2].replace("-", "_"), "")
    if any(extra is tyro.conf.Positional for extra in extras):
        return Flag(group, name, metavar, what, positional=True)
    usage = ", ".join([*aliases, f"--{name}"])
    if hint is bool:
        before, _, last = name.rpartition(".")
        usage += f", --{before}{'.' * bool(before)}no-{last}" if value is True else ""
    else:
        usage += f" {metavar}"
        shown = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
        known = value is not None and value is not dataclasses.MISSING and shown
        what += f" (default: {shown})" if known else ""
    return Flag(group, name, usage, what, positional=False)


def _bare(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """A type without what is noted on it, and the notes, also those below."""
    extras: tuple[Any, ...] = ()
    while typing.get_origin(hint) is Annotated:
        extras += typing.get_args(hint)[1:]
        hint = typing.get_args(hint)[0]
    return hint, extras


def _metavar(hint: Any) -> str:
    """What stands for a value of a type."""
    hint, _ = _bare(hint)
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):  # of a type and None
        return next(_metavar(choice) for choice in inner if choice is not type(None))
    if origin is Literal:
        return "|".join(map(str, inner))
    if origin is tuple:
        several = _metavar(inner[0]) if inner[-1] is Ellipsis else " ".join(map(_metavar, inner))
        return f"{several} ..." if inner[-1] is Ellipsis else several
    return KINDS.get(hint, "VALUE")


def _texts(kind: type) -> dict[str, str]:
    """The text under each field in the source of a class and of those that it extends."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        body = tree.body if isinstance(tree, ast.ClassDef) else []
        for field, below in itertools.pairwise(body):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(field.target, ast.Name)
                and isinstance(below, ast.Expr)
                and isinstance(below.value, ast.Constant)
            ):
                words = str(below.value.value).split()
                texts[field.target.id] = " ".join(words).replace("`", "")
    return texts
