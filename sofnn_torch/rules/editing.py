"""Rules from a file in the place of those that a run has learned."""

import dataclasses
import json
import shutil
from pathlib import Path

from sofnn_torch.evaluate import Loaded
from sofnn_torch.runs import checkpoint, rule_files
from sofnn_torch.runs.directory import Run
from sofnn_torch.runs.places import numbered
from sofnn_torch.runs.session import RunOptions, home_of


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
    config, agent, path, state = loaded
    kind = rule_files.schema(agent)
    table = rule_files.read(file, kind)
    rule_files.put(agent, table)
    if config.rules:  # the rules that learn at the rates of given ones are now these
        agent.net.given = len(table)
        config = dataclasses.replace(config, rules=rule_files.to_csv(kind, table, {}).decode())
        state = state | {"config": dataclasses.asdict(config)}
    # The best and the last ten trials were those of other rules.
    state = state | {"network": checkpoint.describe(agent.net), "recent": [], "best": []}
    state["agent"] = state["agent"] | {"net": agent.net.state_dict()}
    home = home_of(source)
    if home is None:
        raise ValueError(f"{source}: --load needs a run directory or a checkpoint in one")
    home = home if home.name not in ("", "..") else home.resolve()
    usual = numbered(home.with_name(f"{home.name}-edited"))
    places = [home.with_name(name)] if name else usual
    before = json.loads((home / "config.json").read_bytes())
    session = {"versions": before.get("versions"), "commit": before.get("commit")}
    session["edited"] = {"checkpoint": str(path), "rules": str(file)}
    earlier = [*before.get("earlier", []), session]
    with Run.create(places, config, RunOptions.keep, earlier) as run:
        if (trials := home / "trials.csv").exists():
            shutil.copyfile(trials, run.path / "trials.csv")
        run.rewind(state)
    run.close()
    return run.path
