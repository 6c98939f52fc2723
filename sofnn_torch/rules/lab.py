"""The lab: the learned rules as one page that a browser shows without server and network.

The page is plain HTML, CSS and JavaScript (``assets/lab``), put into one file with the policy, the
maze and the trials as data. Its policy follows the equations of ``export/runtime.py``.
"""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sofnn_torch.evaluate import Loaded
from sofnn_torch.export import policy
from sofnn_torch.learners.learner import Learner
from sofnn_torch.maze.layouts import assets
from sofnn_torch.pictures.figures import read_column
from sofnn_torch.rules import played, terms
from sofnn_torch.rules.tables import FIRED
from sofnn_torch.runs import checkpoint, rule_files
from sofnn_torch.runs.factory import make_plan
from sofnn_torch.runs.session import home_of
from sofnn_torch.runs.settings import MAZE, Config
from sofnn_torch.terminal import say

LARGEST = 1_000_000  # bytes that a page should have
TERMS = 5  # on an axis
CURVES = ("steps", "reward", "success", "rules")  # columns of trials.csv


def write(file: Path, source: Path, loaded: Loaded, states: NDArray[np.float32]) -> None:
    """Write the page of a run.

    Args:
        file: of the page.
        source: the run or checkpoint file that was named.
        loaded: what it holds.
        states: of a trial, which says how rules are used. Shape: (T, n).

    Raises:
        ValueError: the learner does not say how its outputs become actions, or trials.csv cannot be
            read.
        OSError: the file cannot be written.
    """
    home = home_of(source)
    trials = home / "trials.csv" if home and (home / "trials.csv").exists() else None
    name = (home or source).resolve().name
    page = filled(data(loaded.config, loaded.agent, states, name, trials, loaded.state["trial"]))
    checkpoint.write_atomically(file, page)
    if len(page) > LARGEST:
        say(f"warning: {file} has {len(page) / 1e6:.1f} MB, a browser may be slow with it")


def filled(content: dict[str, Any]) -> bytes:
    """The page with its data."""
    text = json.dumps(content, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    text = text.replace("<", "\\u003c")  # no end of a script in the data
    return assembled().replace(">{}<", f">{text}<", 1).encode()


def assembled() -> str:
    """The page without data, style and scripts in one file."""
    home = assets() / "lab"

    def style(found: re.Match[str]) -> str:
        return f"<style>\n{(home / found[1]).read_text('utf-8')}</style>"

    def script(found: re.Match[str]) -> str:
        return f"<script>\n{(home / found[1]).read_text('utf-8')}</script>"

    text = (home / "lab.html").read_text("utf-8")
    text = re.sub(r'<link rel="stylesheet" href="(\w+\.css)">', style, text)
    return re.sub(r'<script src="(\w+\.js)"></script>', script, text)


def data(
    config: Config,
    agent: Learner,
    states: NDArray[np.float32],
    name: str,
    trials: Path | None,
    trial: int,
) -> dict[str, Any]:
    """What the page knows, as plain data.

    Rules are rows of n centres, n widths and m consequents, in the digits of a rule file.

    Args:
        config: settings of the run.
        agent: its learner.
        states: of a trial, which says how rules are used. Shape: (T, n).
        name: of the run.
        trials: its trials.csv, if there is one.
        trial: the last trial that the learner has seen.

    Raises:
        ValueError: as `write`.
    """
    kind, task = rule_files.schema(agent), policy.describe(config, agent)
    del task["rules"]
    task |= {"inputs": policy.plain_axes(agent.inputs), "choices": list(agent.choices)}
    task["theta"] = agent.net.theta
    shares, when = agent.usage(states), played.moments(agent, states) + 1
    part = shares * len(states) >= FIRED
    curves = history(trials, trial) if trials else {}
    return {
        "name": name,
        "trial": trial,
        "task": task,
        "maze": maze(config) if config.env == MAZE else None,
        "head": kind.head,
        "low": kind.low.tolist(),
        "high": kind.high.tolist(),
        "counts": list(kind.counts),
        "rules": rule_files.shortest(agent.net.table().detach().T.numpy()).tolist(),
        "usage": [float(f"{share:.3g}") for share in shares.tolist()],
        "moments": np.where(part, when, 0).tolist(),
        "terms": [
            {"names": found.names, "low": found.low, "high": found.high}
            for found in terms.of_rules(agent, TERMS)
        ],
        "curves": curves,
        "born": born(curves.get("rules", []), agent.net.n_rules),
    }


def maze(config: Config) -> dict[str, Any]:
    """The maze as seen from above, in metres."""
    plan = make_plan(config)
    return {
        "size": plan.size,
        "walls": plan.walls,
        "starts": [] if plan.anywhere else plan.starts,
        "goals": plan.goals,
        "goal_radius": plan.goal_radius,
        "subgoals": plan.subgoals,
        "subgoal_radius": plan.subgoal_radius,
        "start_radius": plan.start_radius,
        "radius": plan.robot_radius,
        "told": plan.told,
        "most": config.maze.max_steps,
        "noise": config.maze.motor_noise,
    }


def history(trials: Path, trial: int) -> dict[str, list[float | None]]:
    """Columns of a trials.csv up to a trial; None for what is no finite number.

    Raises:
        ValueError: the file cannot be read.
    """
    found: dict[str, list[float | None]] = {}
    for name in CURVES:
        try:
            column = read_column(trials, name)[:trial]
        except ValueError:
            if name == "success":  # tasks have none
                continue
            raise
        found[name] = [float(f"{v:.6g}") if np.isfinite(v) else None for v in column.tolist()]
    return found


def born(counts: list[float | None], rules: int) -> list[int]:
    """The trial in which each rule was made, from the rules after each trial; or nothing.

    Rules are numbered in the order in which they were made. Where their number fell, or is another
    than that of the trials, somebody edited them, and nobody knows.
    """
    known = [count for count in counts if count is not None]
    if not known or known != sorted(known) or len(known) < len(counts) or known[-1] != rules:
        return []
    return (1 + np.searchsorted(known, np.arange(rules), "right")).tolist()
