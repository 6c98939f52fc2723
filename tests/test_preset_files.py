"""Presets of one's own: what a file may say, what wins, and one line for what is wrong."""

import dataclasses
import tomllib

import pytest
from conftest import settings as short
from hypothesis import given, settings
from hypothesis import strategies as st

from sofnn_torch import Config
from sofnn_torch.cli import main, parse
from sofnn_torch.runs import preset_files
from sofnn_torch.runs.directory import load_config

FILE = """
agent = "q"
trials = 3
[net]
theta = 0.35
max-rules = 99
[maze]
max_steps = 100
[q]
trace-limit = "None"
"""


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "best.toml"
    path.write_text(FILE)
    return path


def test_a_file_lies_on_top_of_the_preset_that_it_chooses(file):
    expected = dataclasses.asdict(Config(agent="q", trials=3))
    expected["net"] |= {"theta": 0.35, "max_rules": 99}
    expected["maze"]["max_steps"], expected["q"]["trace_limit"] = 100, None
    assert dataclasses.asdict(Config.from_file(file)) == expected


def test_flags_win_over_the_file(file):
    words = ["--net.theta", "0.5", "--seed", "7", "--q.trace-limit", "2"]
    config = parse(["--settings", str(file), *words]).config
    assert (config.net.theta, config.seed, config.q.trace_limit) == (0.5, 7, 2.0)
    assert (config.net.max_rules, config.trials, config.agent) == (99, 3, "q")


def test_a_flag_that_chooses_another_preset_moves_what_the_file_leaves_open(tmp_path):
    file = tmp_path / "steps.toml"
    file.write_text("maze.max-steps = 50\n")
    config = parse(["--settings", str(file), "--agent", "q"]).config
    assert config == dataclasses.replace(
        Config(agent="q"), maze=dataclasses.replace(Config(agent="q").maze, max_steps=50)
    )


def test_the_run_has_what_the_file_gave(file, tmp_path):
    words = ["--trials", "1", "--quiet", "--picture-every", "0", "--video-every", "0"]
    assert main(["--settings", str(file), *words]) == 0
    (run,) = (tmp_path / "runs").iterdir()
    assert load_config(run) == Config.from_file(file, trials=1)


@pytest.mark.parametrize(
    "text,message",
    [
        ("net.tetha = 1", "'net.tetha' is no setting of a run; did you mean net.theta?"),
        ("workers = 2", "'workers' is no setting of a run"),
        ("[nett]\ntheta = 0.3", "'nett' is no setting of a run"),
        ("net = 3", "net is a table"),
        ("[trials]\nx = 1", "--trials must be a whole number, got"),
        ("trials = 'many'", "--trials must be a whole number, got 'many'"),
        ("trials = 'None'", "--trials must be a whole number, got None"),
        ("trials = 2.0", "--trials must be a whole number, got 2.0"),
        ("trials = 2020-01-01", "--trials must be a whole number"),
        ("net.theta = nan", "--net.theta must be a finite number"),
        ("net.theta = 3", "--net.theta must lie between 0 and 1, got 3"),
        ("agent = 'dqn'", "--agent must be sga, q or module:Class"),
        ("q.temperature = 1", "q.temperature has no effect with --agent sga"),
        ("trials = ", "not a TOML file (Invalid value"),
        ("a = " + "[" * 100_000, "not a TOML file"),
        ("\udcff", "not a TOML file"),
    ],
)
def test_what_is_wrong_in_a_file_is_one_line_that_names_it(text, message, file, capsys):
    file.write_bytes(text.encode(errors="surrogateescape"))
    assert main(["--settings", "best.toml"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: best.toml: ") and message in line
    assert [path.name for path in file.parent.iterdir()] == [file.name]


@pytest.mark.parametrize(
    "words,message",
    [
        (["--settings", "nowhere"], "nowhere cannot be read (No such file"),
        (["--settings", "best.toml", "--agent", "sga"], "q.trace_limit has no effect"),
        (["--settings", "best.toml", "--resume", "x"], "not a run directory"),
    ],
)
def test_a_file_that_does_not_go_with_the_flags_is_one_line(words, message, file, capsys):
    assert main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


CONFIGS = [
    Config(),
    Config(agent="q", network="fixed", preset="paper", seed=3),
    short("q", q={"trace_limit": None, "trace_cut": False}, net={"theta": 0.31}),
    Config(env="CartPole-v1", trials=7, reward_scale=0.5),
    Config(env="MountainCar-v0", axes=(("a b", "m", -1.0, 2.0, 0.0), ("v", "", 0.0, 1.0, 0.0))),
]


@pytest.mark.parametrize("config", CONFIGS)
def test_written_settings_are_read_again_from_the_file_and_from_the_flags(config, tmp_path):
    file = tmp_path / "x.toml"
    preset_files.write(file, config, "written by a test")
    assert Config.from_file(file) == config
    if not config.axes:  # shown as the shell would split them
        words = preset_files.flags(preset_files.differences(config)).split()
        assert parse(words).config == config


@settings(max_examples=50, deadline=None)
@given(
    st.text()
    | st.none()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.lists(st.integers(0, 9))
)
def test_a_value_survives_toml(value):
    text = f"x = {preset_files._toml(value)}"
    assert tomllib.loads(text)["x"] == ("None" if value is None else value)
