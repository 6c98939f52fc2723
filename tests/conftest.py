"""Shared fixtures: runs of a second or less, and what two runs must have in common."""

import math
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sofnn_torch import evaluate, training
from sofnn_torch.rules import __main__ as rules
from sofnn_torch.runs import checkpoint, rule_files
from sofnn_torch.runs.settings import Config
from sofnn_torch.studies.statistics import Measured
from sofnn_torch.training import RunOptions

torch.set_num_threads(1)
SLOW = [HealthCheck.too_slow, HealthCheck.data_too_large]  # the machine may be busy


# Under nohup it is ignored, by every process that a test starts too.
signal.signal(signal.SIGHUP, signal.SIG_DFL)


def settings(agent="sga", network="sofnn", pose="estimated", seed=0, trials=4, **parts) -> Config:
    """Settings of a run that takes a second; parts as in net={"theta": 0.5}."""
    config = Config(agent=agent, network=network)
    parts = {"maze": {}, "net": {}, agent: {}} | parts
    parts["maze"] = {"max_steps": 120} | parts["maze"]
    parts[agent] = {"replays": 10} | parts[agent]
    if network == "fixed":
        parts["net"] = {"grid": (4, 4, 4)} | parts["net"]
    changes = {name: replace(getattr(config, name), **part) for name, part in parts.items()}
    return replace(config, pose=pose, seed=seed, trials=trials, **changes)


def quick_options(runs: Path, **changes) -> RunOptions:
    """No pictures, no video, no progress bar, a checkpoint every second trial."""
    defaults = {"picture_every": 0, "video_every": 0, "quiet": True, "checkpoint_every": 2}
    return RunOptions(runs=runs, **defaults | changes)


@pytest.fixture
def quick():
    """Makes settings of short runs."""
    return settings


@pytest.fixture
def options(tmp_path):
    """Options of runs under tmp_path / "runs"."""
    return quick_options(tmp_path / "runs")


@pytest.fixture
def call(monkeypatch, capsys):
    """Runs the command of the rules: its exit code, output and error stream."""

    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["rules", *map(str, arguments)])
        try:
            rules.main()
            code = 0
        except SystemExit as stop:
            code = stop.code
        return code, *capsys.readouterr()

    return run


@pytest.fixture(scope="session")
def few(tmp_path_factory):
    """A run with few rules: directory, learner, checkpoint, state, settings. Leave it as it is."""
    config = settings("sga", trials=1, net={"max_rules": 60}, maze={"max_steps": 40})
    path = training.train(config, quick_options(tmp_path_factory.mktemp("few"), name="run"))
    config, agent, file, state = evaluate.load(path)
    return path, agent, file, state, config


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def parameters(agent):
    return agent.net.table().detach().T.numpy()


def written(agent, path, table=None):
    """Write rules to a file: those of the learner if no others are given."""
    write = rule_files.to_json if path.suffix == ".json" else rule_files.to_csv
    table = parameters(agent) if table is None else table
    path.write_bytes(write(rule_files.schema(agent), table, {"usage": [0.5] * len(table)}))
    return path


def equal(a, b) -> bool:
    """Equal to the last bit, through dictionaries, lists and tensors."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(equal, a, b))
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and torch.equal(a, b)
    return a == b


def scalars(run: Path) -> dict[str, list[tuple[int, float]]]:
    """All TensorBoard curves of a run but those of the clock: (trial, value)."""
    events = EventAccumulator(str(run), size_guidance={"scalars": 0})
    events.Reload()
    names = [name for name in events.Tags()["scalars"] if not name.startswith("speed/")]
    return {name: [(e.step, e.value) for e in events.Scalars(name)] for name in names}


def assert_same_run(ours: Path, theirs: Path) -> None:
    """Two runs have equal states, tables and curves; nothing is missing or doubled."""
    (last, state, problems), (other, expected, _) = map(checkpoint.find_latest, (ours, theirs))
    assert last.name == other.name and not problems
    for part in expected:
        assert equal(state[part], expected[part]), f"{part} differs"
    assert (ours / "best.pt").exists() == (theirs / "best.pt").exists()
    if (ours / "best.pt").exists():
        a, b = (checkpoint.load(run / "best.pt") for run in (ours, theirs))
        assert equal(a, b), "best.pt differs"
    assert (ours / "trials.csv").read_bytes() == (theirs / "trials.csv").read_bytes()
    curves = scalars(ours)
    assert curves == scalars(theirs)
    for name, points in curves.items():
        assert [step for step, _ in points] == [*range(1, state["trial"] + 1)], name


@pytest.fixture
def same_run():
    """Asserts that two run directories hold the same run."""
    return assert_same_run


def fixed_interval(value, low=math.nan, high=math.nan):
    """A number over seeds whose interval is the same at every level."""
    return Measured(value, lambda level: (low, high))
