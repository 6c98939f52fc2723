"""Write the learned policy of a run for other programs and machines.

    python -m sofnn_torch.export RUN --to policy.json       # and sofnn_runtime.py: NumPy alone
    python -m sofnn_torch.export RUN --to policy.h          # C99; --precision int16: no library
    python -m sofnn_torch.export RUN --to policy.onnx policy.fis policy.fml policy.fcl
    python -m sofnn_torch.export other.fis --like RUN --to policy.json

The run directory is not changed. docs/export.md says what each format holds and what it cannot.
"""

import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

if __name__ == "__main__":  # Ctrl-C while libraries load
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import tyro

from sofnn_torch.bounds import Settings
from sofnn_torch.evaluate import load
from sofnn_torch.export import c, fcl, fis, fml, graph, policy, sugeno
from sofnn_torch.runs import checkpoint
from sofnn_torch.terminal import check_output, command, plural

READERS: dict[str, Callable[[Path], dict[str, Any]]] = {
    ".json": policy.from_json,
    ".h": c.from_header,
    ".onnx": graph.from_onnx,
}
WRITERS: dict[str, Callable[[dict[str, Any], Path, str], bytes]] = {
    ".json": lambda data, *_: policy.to_json(data),
    ".h": c.to_header,
    ".onnx": graph.to_onnx,
    ".fis": fis.to_fis,
    ".fml": fml.to_fml,
    ".fcl": fcl.to_fcl,
}
SYSTEMS: dict[str, Callable[[Path], sugeno.Sugeno]] = {  # rules of other tools
    ".fis": fis.read,
    ".fml": fml.read,
    ".fcl": fcl.read,
}


@dataclass(frozen=True)
class Options(Settings):
    """Write the learned policy of a run, or of an exported file, in other formats."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Directory of the run, one of its checkpoint files, or a file that this command wrote."""
    to: tuple[Path, ...]
    """Files to write; their endings say in which formats: .json (and a file that plays it with
    NumPy alone), .h (C99), .onnx, .fis (MATLAB, Octave), .fml (IEEE 1855), .fcl (IEC 61131-7)."""
    precision: Literal["float", "int16"] = "float"
    """Numbers of the C header: `float`, with math.h, or `int16`, whole numbers without any
    library."""
    like: Path | None = None
    """Where RUN is a .fis, .fml or .fcl file: the run or exported policy whose axes and actions it
    is for."""
    best: bool = False
    """Take the checkpoint with the best last 10 trials instead of the latest."""


def check(options: Options) -> None:
    """Check what can be checked before anything is loaded.

    Raises:
        ValueError: naming the flag.
    """
    if not options.to:
        raise ValueError("--to needs a file to write")
    for path in options.to:
        check_output("--to", path, tuple(WRITERS))
    if options.precision != "float" and not any(p.suffix.lower() == ".h" for p in options.to):
        raise ValueError("--precision is for a C header: give --to a file that ends in .h")
    if (options.run.suffix.lower() in SYSTEMS) != bool(options.like):
        raise ValueError("--like RUN and a .fis, .fml or .fcl file as source need each other")
    if options.best and options.run.suffix.lower() in READERS:
        raise ValueError(f"--best chooses a checkpoint of a run, and {options.run} is a policy")


def source(path: Path, options: Options) -> dict[str, Any]:
    """The policy of a run or a file, as plain data.

    Raises:
        ValueError: one line on a run or a file that cannot be used.
    """
    reader = READERS.get(path.suffix.lower())
    if reader and not path.is_dir():
        return reader(path)
    loaded = load(path, options.best)
    return policy.describe(loaded.config, loaded.agent)


def run(options: Options) -> None:
    """What the command does.

    Raises:
        ValueError: the run cannot be used, or a format cannot hold its policy.
        OSError: a file cannot be written.
    """
    check(options)
    data = source(options.like or options.run, options)
    if options.like:
        if "fixed" in data:
            raise ValueError(f"--like {options.like} holds rounded numbers: take the run itself")
        data = sugeno.as_policy(SYSTEMS[options.run.suffix.lower()](options.run), data)
    if "fixed" in data and any(path.suffix.lower() != ".h" for path in options.to):
        raise ValueError(f"{options.run} holds rounded numbers: export the run itself")
    written = [
        (path, WRITERS[path.suffix.lower()](data, path, options.precision)) for path in options.to
    ]
    folders = dict.fromkeys(path.parent for path in options.to if path.suffix.lower() == ".json")
    written += [(folder / policy.RUNTIME, policy.runtime_source()) for folder in folders]
    count = len(data["fixed"].centres if "fixed" in data else data["rules"])
    print(f"{options.run}: {data['learner']} on {data['task']}, {plural(count, 'rule')}")
    for path, content in written:
        checkpoint.write_atomically(path, content)
        print(f"written: {path} ({len(content):,} bytes)")


def main() -> None:
    """Entry point of ``python -m sofnn_torch.export``."""
    command(run, Options, __doc__)


if __name__ == "__main__":
    main()
