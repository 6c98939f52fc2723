"""Other rules in the place of those that a run has learned: from a file, or fewer ones."""

import dataclasses
import json
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sofnn_torch.evaluate import Loaded
from sofnn_torch.learners.learner import Learner
from sofnn_torch.runs import checkpoint, presets, rule_files
from sofnn_torch.runs.directory import Run
from sofnn_torch.runs.places import numbered
from sofnn_torch.runs.session import RunOptions, home_of
from sofnn_torch.runs.settings import Config


def edited(source: Path, loaded: Loaded, file: Path, name: str | None = None) -> Path:
    """Make a run with the rules in a file and the rest of a state; its directory.

    Args:
        source: the run or checkpoint file that was named.
        loaded: what it holds; the learner gets the rules.
        file: the rules.
        name: of the new run, beside the old one; by default that of the old one with `-edited`.

    Raises:
        ValueError: rules that the run cannot have, or a directory that cannot be written; nothing
            is left behind then.
    """
    config, agent, _, _ = loaded
    rule_files.put(agent, rule_files.read(file, rule_files.schema(agent)))
    if config.rules:  # the rules that learn at the rates of given ones are now these
        agent.net.given = agent.net.n_rules
        config = dataclasses.replace(config, rules=text_of(agent))
    places = places_of(source, name, "edited", "--load")
    return renewed(source, loaded, config, agent, places, {"edited": {"rules": str(file)}})


def text_of(agent: Learner) -> str:
    """The rules of a learner as the text of a rule file, for `Config.rules`."""
    table = agent.net.table().detach().T.numpy()
    return rule_files.to_csv(rule_files.schema(agent), table, {}).decode()


def keeping(config: Config, agent: Learner) -> Config:
    """Settings of a run that begins with the rules of a learner, and keeps them: see `--rules`."""
    tables = {name: getattr(config, name) for name in ("net", "sga", "q")}
    return dataclasses.replace(config, rules=text_of(agent), **presets.careful(tables))


def places_of(source: Path, name: str | None, ending: str, flag: str) -> Iterable[Path]:
    """Where a run made of another one may be: beside it.

    Args:
        source: the run or checkpoint file that was named.
        name: of the new run.
        ending: behind the name of the old one, if no name is given.
        flag: that asks for it.

    Raises:
        ValueError: a checkpoint that lies in no run.
    """
    home = home_of(source)
    if home is None:
        raise ValueError(f"{source}: {flag} needs a run directory or a checkpoint in one")
    home = home if home.name not in ("", "..") else home.resolve()
    return [home.with_name(name)] if name else numbered(home.with_name(f"{home.name}-{ending}"))


def renewed(
    source: Path,
    loaded: Loaded,
    config: Config,
    agent: Learner,
    places: Iterable[Path],
    why: dict[str, dict[str, Any]],
) -> Path:
    """Make a run with other rules and the rest of a state; its directory.

    Args:
        source: the run or checkpoint file that was named, in a run.
        loaded: what it holds.
        config: settings of the new run.
        agent: a learner with these settings and the rules.
        places: where the new run may be.
        why: what was done, for config.json; the checkpoint is added.

    Raises:
        ValueError: a directory that cannot be written; nothing is left behind then.
    """
    # The best and the last ten trials were those of other rules.
    state = loaded.state | {"config": dataclasses.asdict(config), "recent": [], "best": []}
    state["network"], fresh = checkpoint.describe(agent.net), agent.state_dict()
    state["agent"] = {key: state["agent"][key] for key in fresh} | {"net": fresh["net"]}
    home = home_of(source)
    assert home is not None  # `places_of` looked
    before = json.loads((home / "config.json").read_bytes())
    session = {"versions": before.get("versions"), "commit": before.get("commit")}
    session |= {what: {"checkpoint": str(loaded.file)} | how for what, how in why.items()}
    earlier = [*before.get("earlier", []), session]
    with Run.create(places, config, RunOptions.keep, earlier) as run:
        if (trials := home / "trials.csv").exists():
            shutil.copyfile(trials, run.path / "trials.csv")
        run.rewind(state)
    run.close()
    return run.path
