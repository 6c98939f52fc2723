"""A run that begins with rules from a file and nothing else: ``rules --new FILE``."""

from collections.abc import Sequence

from sofnn_torch import cli
from sofnn_torch.runs import session
from sofnn_torch.terminal import plural, program, quoted

FLAG = "--new"


def is_asked(argv: Sequence[str]) -> bool:
    """Whether a command line is about a new run."""
    return any(word.partition("=")[0] == FLAG for word in argv)


def begin(argv: Sequence[str]) -> int:
    """Make the run that a training would begin with; the exit code.

    Args:
        argv: flags of ``train.py``, with ``--new`` in the place of ``--rules``.

    Raises:
        ValueError: flags or rules that cannot be used; nothing is left behind then.
    """
    words = [
        word.replace(FLAG, "--rules", 1) if word.partition("=")[0] == FLAG else word
        for word in argv
    ]
    flags = cli.parse(words)
    if flags.resume or flags.again or flags.seeds is not None:
        raise ValueError("--new goes with neither --resume, --again nor --seeds")
    begun = session.begin(flags.config, flags.options)
    begun.close()
    run, rules = quoted(begun.run.path), plural(begun.agent.net.n_rules, "rule")
    lines = [
        f"{begun.run.path}: {rules}, nothing learned yet",
        "next:",
        f"  {program('evaluate')} {run}",
        f"  {program('rules')} {run}",
        f"  {program('train')} --resume {run}    (learns on from them)",
    ]
    print("\n".join(lines))
    return 0
