"""Presets of one's own: TOML files of settings that `train.py --settings FILE` starts from.

    agent = "q"
    trials = 120
    [net]
    theta = 0.3
    [q]
    temperature = 0.002
    value-limit = "None"

Names are those of the flags, a table for what stands before the dot; "None" is what the flag takes
as None. Whatever is not given is that of the preset of the package that the others choose.
"""

import dataclasses
import difflib
import json
import shlex
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sofnn_torch.runs import checkpoint, presets
from sofnn_torch.runs.directory import LARGEST_SETTINGS, flatten
from sofnn_torch.runs.settings import BASIC, Config, why_idle

KNOWN = flatten(dataclasses.asdict(Config()))


def from_file(path: Path | str, **changes: Any) -> Config:
    """The settings in a file.

    Args:
        path: of the file.
        changes: settings of the top level that win over those of the file, as in ``agent="q"``.

    Raises:
        ValueError: one line on what cannot be read, an unknown name, a wrong type, a value out of
            range or a setting that has no effect.
    """
    path, given = Path(path), read(path)
    try:
        config = make(given | changes)
        idle = config.idle()
        for name in given:
            if why := why_idle(idle, name):
                raise ValueError(f"{name} has no effect {why}")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return config


def read(path: Path) -> dict[str, Any]:
    """The entries of a file by their dotted names.

    Raises:
        ValueError: the file cannot be read, or a name is no setting.
    """
    try:
        data = tomllib.loads(checkpoint.read_file(path, LARGEST_SETTINGS).decode())
    except OSError as error:
        raise ValueError(f"{path} cannot be read ({error.strerror})") from None
    except RecursionError:
        raise ValueError(f"{path}: not a TOML file (nested too deeply)") from None
    except ValueError as error:  # not TOML, or not UTF-8
        raise ValueError(f"{path}: not a TOML file ({' '.join(str(error).split())})") from None
    entries: dict[str, Any] = {}
    for name, value in data.items():
        if name in presets.TABLES:
            if not isinstance(value, dict):
                raise ValueError(f"{path}: {name} is a table: its settings stand below [{name}]")
            entries |= {f"{name}.{entry}": inner for entry, inner in value.items()}
        else:
            entries[name] = value
    entries = {name.replace("-", "_"): value for name, value in entries.items()}
    for name, value in entries.items():
        if name not in KNOWN:
            hint = "".join(
                f"; did you mean {m}?" for m in difflib.get_close_matches(name, KNOWN, 1)
            )
            raise ValueError(f"{path}: {name[:60]!r} is no setting of a run{hint}")
        if value == "None":
            entries[name] = None
    return entries


def make(entries: Mapping[str, Any]) -> Config:
    """Settings from dotted names, on top of the preset of the package that they choose.

    Raises:
        ValueError: an entry that is no setting, a wrong type or a value out of range.
    """
    if unknown := sorted(entries.keys() - KNOWN.keys()):
        raise ValueError(f"{unknown[0]!r} is not a setting")
    config = Config(**{name: value for name, value in entries.items() if "." not in name})
    tables: dict[str, dict[str, Any]] = {}
    for name, value in entries.items():
        table, dot, entry = name.partition(".")
        if dot:
            tables.setdefault(table, {})[entry] = value
    parts = {name: dataclasses.replace(getattr(config, name), **t) for name, t in tables.items()}
    return dataclasses.replace(config, **parts)


def differences(config: Config) -> dict[str, Any]:
    """What settings change against the preset of the package, by dotted names; the choice first."""
    chosen = {name: getattr(config, name) for name in BASIC}
    usual = flatten(dataclasses.asdict(Config(**chosen)))
    first = {name: value for name, value in chosen.items() if value != KNOWN[name]}
    after = flatten(dataclasses.asdict(config))
    return first | {name: value for name, value in after.items() if value != usual[name]}


def flags(given: Mapping[str, Any]) -> str:
    """Settings by dotted names as flags of ``train.py``."""
    words = []
    for name, value in given.items():
        table, dot, entry = name.rpartition(".")
        is_off = value is False
        words.append(f"--{table}{dot}{'no-' * is_off}{entry}".replace("_", "-"))
        if not isinstance(value, bool):
            words += map(_word, np.ravel(np.array(value, dtype=object)))
    return " ".join(words)


def _word(value: Any) -> str:
    return f"{value:.12g}" if isinstance(value, float) else shlex.quote(str(value))


def write(path: Path, config: Config, about: str) -> None:
    """Write settings as a file for ``--settings``.

    Args:
        path: of the file.
        config: the settings; only what differs from the preset of the package is written.
        about: a line that says where they come from.

    Raises:
        OSError: the file cannot be written.
    """
    given = differences(config)
    lines, table = [f"# {about}"], ""
    for name, value in sorted(given.items(), key=lambda item: "." in item[0]):
        before, _, entry = name.rpartition(".")
        if before != table:
            table = before
            lines.append(f"\n[{table}]")
        lines.append(f"{entry.replace('_', '-')} = {_toml(value)}")
    checkpoint.write_atomically(path, "".join(f"{line}\n" for line in lines).encode())


def _toml(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    text = "None" if value is None else value
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
