r"""Checkpoint files: written whole or not at all, read only if every bit is as it was written.

A file is one line of text and a payload (docs/checkpoints.md):

    sofnn-torch checkpoint <format version> <sha256 of version and payload>\n
    payload: a dictionary of tensors, numbers and text, as written by torch.save

The line has the same form in every format version. Payloads are read with ``weights_only=True``,
which cannot run code.
"""

import contextlib
import copy
import hashlib
import io
import os
import pickletools
import re
import secrets
import stat
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from sofnn_torch.learners.learner import Learner
from sofnn_torch.network.sofnn import SOFNN

VERSION = 2
HEADER = re.compile(rb"sofnn-torch checkpoint ([0-9]{1,9}) ([0-9a-f]{64})\n")
HEADER_SIZE = 200  # no header line is longer
LARGEST = 2**30  # bytes of a file; a million rules take less
# What a payload is made of; torch would read more, some of which takes memory as it likes.
BUILT_OF = re.compile(r"torch \w+Storage|torch\._utils _rebuild_tensor_v2|collections OrderedDict")
NAME = re.compile(r"checkpoint-[0-9]+\.pt")
ADVICE = "; use an earlier checkpoint"
KINDS = {
    "config": dict,
    "trial": int,
    "total_steps": int,
    "recent": list,
    "best": list,
    "network": dict,
    "agent": dict,
    "env": dict,
}


class CheckpointError(ValueError):
    """A checkpoint cannot be used; the message is one line that says why and what to do."""


def save(path: Path, state: dict[str, Any]) -> None:
    """Write a state atomically: the file at path is the old one or the new one, never a part.

    Raises:
        OSError: the file system refused; the old file, if any, is untouched.
    """
    buffer = io.BytesIO()
    torch.save(state, buffer)
    payload = buffer.getvalue()
    header = b"sofnn-torch checkpoint %d %s\n" % (VERSION, _digest(VERSION, payload))
    write_atomically(path, header + payload)


def load(path: Path) -> dict[str, Any]:
    """Read the state that `save` wrote.

    Raises:
        CheckpointError: no such file, not a checkpoint, damaged, or of a newer version.
    """
    payload = _payload(path)
    try:
        _check_parts(payload)
        state = torch.load(io.BytesIO(payload), weights_only=True)
        _check_extent(state, len(payload))
    except Exception as error:  # torch raises many kinds for a payload it does not know
        reason = str(error).partition("\n")[0]
        raise CheckpointError(f"{path}: not a checkpoint of sofnn-torch ({reason})") from None
    _check_kinds(path, state)
    return state


def restore(path: Path, state: dict[str, Any], agent: Learner, env: Any) -> None:
    """Put a loaded state into an agent and an environment made from the same settings.

    Raises:
        CheckpointError: shapes or entries do not fit; agent and env must not be used then.
    """
    fresh = snapshot(agent, env)
    reason = _misfit({part: fresh[part] for part in ("agent", "env")}, state)
    try:
        if not reason:
            agent.load_state_dict(state["agent"])
            env.load_state_dict(state["env"])
            reason = _misfit(describe(agent.net), state["network"])
            if not reason and state["network"] != describe(agent.net):
                reason = f"{state['network']}"
    except Exception as error:  # any misfit raises something else: sizes, values
        reason = " ".join(str(error).split())
    if reason:
        raise CheckpointError(f"{path}: does not fit its settings ({reason[:200]})")


def _misfit(expected: Any, found: Any, name: str = "state") -> str:
    """The first place where found has another type than expected; empty if there is none."""
    if type(found) is not type(expected):
        return f"{name} is of type {type(found).__name__}, not {type(expected).__name__}"
    if isinstance(expected, torch.Tensor) and found.dtype != expected.dtype:
        return f"{name} holds {found.dtype}, not {expected.dtype}"
    if isinstance(expected, dict):
        for key in expected:
            if key not in found:
                return f"{name} has no {key}"
            if reason := _misfit(expected[key], found[key], str(key)):
                return reason
    if isinstance(expected, list):
        if len(expected) != len(found):
            return f"{name} has {len(found)} entries, not {len(expected)}"
        pairs = zip(expected, found, strict=True)
        return next((reason for a, b in pairs if (reason := _misfit(a, b, name))), "")
    return ""


def describe(net: SOFNN) -> dict[str, Any]:
    """Constructor arguments and size of a network, to check a state against."""
    return {
        "n_inputs": net.n_inputs,
        "n_outputs": net.n_outputs,
        "rules": net.n_rules,
        "growth": net.growth,
        "theta": net.theta,
        "max_rules": net.max_rules,
        "blocks": list(net.block_sizes),
    }


def snapshot(agent: Learner, env: Any) -> dict[str, Any]:
    """A copy of all that the future of agent and env depends on."""
    # state_dict() of a module refers to the live parameters.
    return {
        "network": describe(agent.net),
        "agent": copy.deepcopy(agent.state_dict()),
        "env": copy.deepcopy(env.state_dict()),
    }


def checkpoints(directory: Path) -> list[Path]:
    """The numbered checkpoints of a run, newest first."""
    found = [path for path in directory.iterdir() if NAME.fullmatch(path.name)]
    return sorted(found, key=number, reverse=True)


def number(path: Path) -> int:
    """The trial in the name of a numbered checkpoint."""
    return int(path.stem.removeprefix("checkpoint-"))


def find_latest(
    directory: Path, check: Callable[[Path, dict[str, Any]], None] | None = None
) -> tuple[Path, dict[str, Any], list[str]]:
    """The newest checkpoint that can be used, its state, and what is wrong with newer ones.

    Args:
        directory: of the run.
        check: raises CheckpointError for a file and its state that cannot be used here.

    Raises:
        CheckpointError: there is none.
    """
    problems: list[str] = []
    for path in checkpoints(directory):
        try:
            state = load(path)
            if check:
                check(path, state)
            return path, state, problems
        except CheckpointError as error:
            problems.append(str(error).removesuffix(ADVICE))
    reason = f" ({problems[0]})" if problems else "; train anew"
    raise CheckpointError(f"{directory}: no checkpoint to go on from{reason}")


def write_atomically(path: Path, data: bytes) -> None:
    """Replace a file by data so that a crash or a full disk leaves the old or the new file.

    A symbolic link stays one, a file that was there keeps its mode, and what is no file but a
    device or a pipe is written to.

    Raises:
        OSError: the file system refused; no part of the new file stays behind.
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file() and not target.is_dir():
        target.write_bytes(data)
        return
    temporary = target.with_name(f".{secrets.token_hex(8)}.tmp")
    try:
        with open(temporary, "xb") as file:
            with contextlib.suppress(FileNotFoundError):
                os.fchmod(file.fileno(), stat.S_IMODE(target.stat().st_mode))
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):  # of the name that the caller knows
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise
    sync_directory(target.parent)


def sync_directory(directory: Path) -> None:
    """Make renames in a directory survive a power failure, where the system can."""
    if os.name != "posix":
        return
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _payload(path: Path) -> memoryview:
    """The payload of a file of this format that is as it was written.

    Raises:
        CheckpointError: it is not.
    """
    try:
        with open(path, "rb") as file:
            header = HEADER.fullmatch(file.readline(HEADER_SIZE))
        data = read_file(path, LARGEST) if header else b""
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise CheckpointError(f"{path}: {error}") from None
    if header is None:
        raise CheckpointError(f"{path}: not a checkpoint of sofnn-torch")
    version, payload = int(header[1]), memoryview(data)[header.end() :]
    if header[2] != _digest(version, payload):
        raise CheckpointError(f"{path}: damaged or cut off (its checksum differs){ADVICE}")
    if version > VERSION:
        raise CheckpointError(
            f"{path}: format {version}, this program reads up to {VERSION}; update sofnn-torch"
        )
    if version < VERSION:
        raise CheckpointError(
            f"{path}: format {version} of an older version, this program reads {VERSION}: train "
            "anew, or use the version of sofnn-torch that wrote it (0.1.0)"
        )
    return payload


def read_file(path: Path, most: int) -> bytes:
    """The content of a file that should be small.

    Raises:
        ValueError: it has more than `most` bytes.
        OSError: it cannot be read.
    """
    with open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise ValueError(f"{size:,} bytes are too many")
        return file.read(most)


def _check_parts(payload: memoryview) -> None:
    """Raise ValueError if the parts of a payload would take more memory than it has bytes."""
    with zipfile.ZipFile(io.BytesIO(payload)) as archive:
        parts = archive.infolist()
        packed = any(part.compress_type != zipfile.ZIP_STORED for part in parts)
        if packed or sum(part.file_size for part in parts) > len(payload):
            raise ValueError("its parts are larger than the file")
        (pickle,) = (part for part in parts if part.filename.endswith("/data.pkl"))
        for operation, what, _ in pickletools.genops(archive.read(pickle)):
            if operation.name == "GLOBAL" and not BUILT_OF.fullmatch(str(what)):
                raise ValueError(f"it has a {what}")


def _check_extent(state: Any, most: int) -> None:
    """Raise ValueError on tensors that repeat few numbers, and on parts inside each other.

    Both take next to nothing until they are copied or compared.
    """
    rest = [state]
    while rest and most >= 0:
        part = rest.pop()
        most -= 1
        if isinstance(part, torch.Tensor):
            most -= part.numel() * part.element_size()
            if part.device.type != "cpu" or part.layout != torch.strided:
                raise ValueError("a tensor that is not dense")
        elif isinstance(part, dict | list | tuple | str | bytes):
            most -= len(part)
            if most >= 0 and isinstance(part, dict):
                rest += [*part.keys(), *part.values()]
            elif most >= 0 and isinstance(part, list | tuple):
                rest += part
    if most < 0:
        raise ValueError("its content is larger than the file")


def _digest(version: int, payload: bytes | memoryview) -> bytes:
    digest = hashlib.sha256(b"%d\n" % version)
    digest.update(payload)
    return digest.hexdigest().encode()


def _check_kinds(path: Path, state: Any) -> None:
    if not isinstance(state, dict):
        raise CheckpointError(f"{path}: not a checkpoint of sofnn-torch (no dictionary)")
    for key, kind in KINDS.items():
        if type(state.get(key)) is not kind:
            raise CheckpointError(f"{path}: not a checkpoint of sofnn-torch (no {key})")
