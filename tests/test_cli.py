"""The command line: what a newcomer sees, and one line for whatever is wrong."""

import io
import json
import os
import re
import runpy
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import asdict
from pathlib import Path

import pytest
from conftest import quick_options
from conftest import settings as short
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from sofnn_torch import cli, terminal, training
from sofnn_torch.cli import main, parse
from sofnn_torch.runs import checkpoint, jobs, parallel
from sofnn_torch.runs.directory import load_config
from sofnn_torch.runs.factory import make_agent
from sofnn_torch.runs.settings import Config, from_dict

ROOT = Path(__file__).parents[1]
QUICK = ["--quiet", "--picture-every=0", "--video-every=0", "--maze.max-steps=100"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def run(here):
    """A run of two trials."""
    assert main(["--trials", "2", *QUICK]) == 0
    return Path("runs/sga-sofnn-estimated-s0")


def contents(directory):
    files = (path for path in Path(directory).rglob("*") if path.is_file())
    return {path: path.read_bytes() for path in files}


def bad(arguments, capsys):
    """The line with which arguments are refused."""
    capsys.readouterr()
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    (line,) = err.splitlines()
    assert line.startswith("error: ") and not out
    return line


# ------------------------------------------------------------------------------------- good input


def test_the_help_begins_with_examples_and_shows_every_setting(capsys):
    with pytest.raises(SystemExit) as stop:
        parse(["--help-all"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert text.index("train.py --resume") < text.index("--agent TEXT")
    names = [name for name, part in asdict(Config()).items() if not isinstance(part, dict)]
    nested = asdict(Config()).items()
    names += [
        f"{part}.{name}" for part, fields in nested if isinstance(fields, dict) for name in fields
    ]
    for name in names:
        assert f"--{name}".replace("_", "-") in text


def test_the_help_shows_the_values_of_the_chosen_preset(capsys):
    with pytest.raises(SystemExit):
        parse(["--preset", "paper", "--agent", "q", "--help-all"])
    text = re.sub(r"[│\s]+", " ", capsys.readouterr().out)
    rate = Config(agent="q", network="sofnn", preset="paper").q.trace_decay
    assert f"Lambda of the eligibility traces; 0 in the paper. (default: {rate})" in text


@pytest.mark.parametrize("agent", ["sga", "q"])
@pytest.mark.parametrize("network", ["sofnn", "fixed"])
@pytest.mark.parametrize("name", ["default", "paper"])
def test_flags_lie_on_top_of_the_preset(agent, network, name):
    words = f"--preset {name} --network={network} --agent {agent} --net.width-position 0.05"
    config = parse(words.split()).config
    expected = asdict(Config(agent=agent, network=network, preset=name))
    expected["net"]["width_position"] = 0.05
    assert asdict(config) == expected


def test_a_run_from_the_command_line(run):
    assert load_config(run).maze.max_steps == 100
    assert checkpoint.find_latest(run)[1]["trial"] == 2


def test_resume_with_more_trials(run):
    assert main(["--resume", str(run), "--trials", "3", *QUICK]) == 0
    assert checkpoint.find_latest(run)[1]["trial"] == 3


def test_flags_that_agree_with_the_run_are_fine(run):
    theta = str(load_config(run).net.theta)
    assert main(["--resume", str(run), "--trials", "3", "--net.theta", theta, *QUICK]) == 0


def test_train_py_is_the_same_program(here, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["train.py", "--tirals", "1"])
    before = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(SystemExit) as stop:
            runpy.run_path(str(ROOT / "train.py"), run_name="__main__")
    finally:
        signal.signal(signal.SIGINT, before)
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: Unrecognized options: --tirals, 1; did you mean --trials?")


def test_a_reader_that_leaves_early_is_no_error(here):
    command = [sys.executable, str(ROOT / "train.py"), "--help"]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    child.stdout.close()
    assert child.stderr.read() == b""
    assert child.wait(timeout=120) == 0


def test_a_bad_mujoco_gl_is_one_line_and_an_import_error_that_can_be_caught(here):
    code = f"""
import runpy, sys
try:
    import sofnn_torch.training
except ImportError as error:
    print("caught:", error)
sys.argv = ["train.py", "--trials", "1"]
runpy.run_path({str(ROOT / "train.py")!r}, run_name="__main__")
"""
    command = [sys.executable, "-c", code]
    environment = os.environ | {"MUJOCO_GL": "nonsense"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120)
    assert done.returncode == 2 and not contents(here)
    (line,) = done.stderr.splitlines()
    assert "MUJOCO_GL=nonsense" in line and "egl, osmesa or glfw" in line
    assert re.match("caught: .*MUJOCO_GL=nonsense", done.stdout)


def test_what_an_encoding_lacks_prints_as_question_marks(monkeypatch):
    buffer = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(buffer, encoding="ascii"))
    with terminal.output():
        print("150 ± 60 mm")
    assert buffer.getvalue() == b"150 ? 60 mm\n"


def test_interruption_says_how_to_go_on(here, monkeypatch, capsys):
    real = training.play

    def interrupted(*arguments, **keywords):
        os.kill(os.getpid(), signal.SIGINT)
        return real(*arguments, **keywords)

    monkeypatch.setattr(training, "play", interrupted)
    assert main(["--trials", "2", *QUICK]) == 130
    assert "--resume runs/sga-sofnn-estimated-s0" in capsys.readouterr().err


def test_divergence_is_one_line_and_exit_code_1(here, capsys):
    assert main(["--agent", "q", "--q.rate-action", "1e3", *QUICK]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: trial 1 diverged: ")
    (file,) = Path("runs").rglob("divergence-1.pt")
    assert main(["--again", str(file)]) == 1


@pytest.mark.parametrize("rate", ["mean", "deviation"])
def test_a_rate_that_bounds_would_hide_is_refused(rate, here, capsys):
    assert main([f"--sga.rate-{rate}", "1e3", *QUICK]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "must be at most 500" in line and not Path("runs").exists()


RATES = [f"sga.rate-{name}" for name in ("value", "centre", "width")]
RATES += [f"q.rate-{name}" for name in ("state", "action", "constant", "centre", "width")]


@pytest.mark.parametrize(
    "rate", [pytest.param(r, marks=[pytest.mark.slow] * (i % 2)) for i, r in enumerate(RATES)]
)
def test_a_learning_rate_of_a_thousand_ends_in_a_message(rate, here, capsys):
    words = ["--agent", rate.partition(".")[0], f"--{rate}", "1e3", "--trials", "12", *QUICK]
    assert main([*words, "--maze.max-steps=2000"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert re.match(r"error: trial \d+ diverged: .*rules, as in rule", line)
    (file,) = Path("runs").rglob("divergence-*.pt")
    assert main(["--again", str(file)]) == 1
    assert checkpoint.load(file)["reason"] in capsys.readouterr().err


@pytest.mark.parametrize("agent", ["sga", "q"])
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_the_presets_stay_within_the_limits_of_the_guard(agent, preset, here, capsys):
    words = ["--agent", agent, "--preset", preset, "--trials", "2", *QUICK]
    assert main([*words, "--maze.max-steps=1000"]) == 0
    assert not capsys.readouterr().err


@pytest.mark.parametrize("agent", ["sga", "q"])
def test_growth_without_end_stops_at_the_limit_and_says_so(agent, here, capsys):
    words = ["--agent", agent, "--net.theta", "0.999", "--max-rules", "50", "--trials", "2", *QUICK]
    assert main([*words, "--maze.max-steps=500"]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "warning: 50 rules reached (--net.max-rules): no more are added"
    (run,) = Path("runs").iterdir()
    assert checkpoint.find_latest(run)[1]["network"]["rules"] == 50


# -------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    "words,message",
    [
        ("--net.tetha 0.5", "did you mean --net.theta?"),
        ("--tirals 5", "did you mean --trials?"),
        ("--reusme x", "did you mean --resume?"),
        ("--sga.rate-men 1", "did you mean --sga.rate-mean?"),
        ("extra", "extra"),
        ("--agent dqn", "--agent must be sga, q or module:Class of a learner, got 'dqn'"),
        ("--network lstm", "--network must be one of 'sofnn', 'fixed', got 'lstm'"),
        ("--preset best", "--preset must be one of 'default', 'paper', got 'best'"),
        ("--pose gps", "--pose must be one of 'estimated', 'true', 'odometry', got 'gps'"),
        ("--trials", "--trials needs a value"),
        ("--trials many", "--trials must be a whole number, got 'many'"),
        ("--trials -3", "--trials must be positive, got -3"),
        ("--trials 0", "--trials must be positive"),
        ("--seed -1", "--seed must not be negative"),
        ("--seed 9223372036854775808", "--seed must lie between -2**63 and 2**63"),
        ("--maze.max-steps 99999999999999999999", "--maze.max-steps must lie between -2**63"),
        ("--seeds 0,9223372036854775808", "--seed must lie between -2**63 and 2**63"),
        ("--net.theta 0", "--net.theta must lie between 0 and 1"),
        ("--net.theta 1", "--net.theta must lie between 0 and 1"),
        ("--net.theta nan", "--net.theta must be a number, got 'nan'"),
        ("--net.theta inf", "--net.theta must be a number, got 'inf'"),
        ("--net.theta 1e999", "--net.theta must be a number, got '1e999'"),
        ("--net.theta 0_1.5", "--net.theta must be a number, got '0_1.5'"),
        ("--net.theta \u0663e-1", "--net.theta must be a number, got '\u0663e-1'"),
        ("--trials 1_0", "--trials must be a whole number, got '1_0'"),
        ("--trials \u0663", "--trials must be a whole number, got '\u0663'"),
        ("--network fixed --net.grid 4 4 1_0", "--net.grid must be whole numbers, got '4 4 1_0'"),
        ("--own rate 1_0", "--own must be NAME NUMBER ..., got 'rate 1_0'"),
        ("--seeds 1_0", "--seeds must be a list"),
        ("--seeds 0-\u0663", "--seeds must be a list"),
        ("--seeds 5,7-3", "--seeds must be a list"),
        ("--seeds 5,0--3", "--seeds must be a list"),
        ("--net.width-position 0", "--net.width-position must be positive"),
        ("--net.width-heading -1", "--net.width-heading must be positive"),
        ("--net.width-position 1e-6", "every width must be at least 0.001"),
        ("--net.width-heading 1e-6", "every width must be at least 0.001"),
        ("--agent q --q.coding antecedent --net.width-action 1e-6", "every width must be at least"),
        ("--net.max-rules 0", "--net.max-rules must be positive"),
        ("--net.theta x", "--net.theta must be a number, got 'x'"),
        ("--network fixed --net.grid 4 4", "--net.grid needs 3 values"),
        ("--net.grid 4 4 x", "--net.grid must be whole numbers, got '4 4 x'"),
        ("--agent q --q.trace-limit x", "--q.trace-limit must be a number or None, got 'x'"),
        ("--network fixed --net.grid 999 999 999", "--net.max-rules"),
        ("--sga.gamma 1.5", "--sga.gamma must lie in"),
        ("--sga.rate-mean -1", "--sga.rate-mean must not be negative"),
        ("--sga.rate-mean nan", "--sga.rate-mean must be a number, got 'nan'"),
        ("--agent q --q.temperature 0", "--q.temperature must be positive"),
        ("--agent q --q.segments 1000000000", "--q.segments must be at most"),
        ("--agent q --sga.gamma 0.5", "--sga.gamma has no effect with --agent q"),
        ("--q.gamma 0.5", "--q.gamma has no effect with --agent sga"),
        ("--net.grid 3 3 3", "--net.grid has no effect without --network fixed"),
        ("--network fixed --net.theta 0.9", "--net.theta has no effect with --network fixed"),
        ("--network fixed --net.growth literal", "--net.growth has no effect with --network fixed"),
        ("--network fixed --net.interpolate", "--net.interpolate has no effect with --network"),
        ("--network fixed --net.grid-action 4", "no effect without --q.coding antecedent"),
        ("--agent q --net.width-action 1", "no effect without --q.coding antecedent"),
        ("--sga.constant 1", "--sga.constant has no effect with --sga.baseline value"),
        ("--preset paper --sga.rate-value 2", "has no effect without a learned baseline"),
        ("--sga.replays 0 --sga.memory 9", "--sga.memory has no effect without replay"),
        ("--workers 2", "--workers has no effect without --seeds"),
        ("--cluster slurm", "--cluster has no effect without --seeds"),
        (
            "--seeds 0-3 --workers 2 --cluster tcp://a:1",
            "--workers has no effect with --cluster tcp",
        ),
        ("--seeds 0-3 --cluster sulrm", "--cluster must be slurm or the address"),
        ("--again x --agent q --trials 5", "--agent has no effect with --again"),
        ("--again x --trials 5", "--trials has no effect with --again"),
        ("--again x --seeds 0-3", "--seeds has no effect with --again"),
        ("--maze.hold 0", "--maze.hold must be positive"),
        ("--maze.hold 10000000000", "--maze.hold must be at most"),
        ("--maze.motor-noise 1", "--maze.motor-noise must lie in"),
        ("--keep 0", "--keep must be at least 1"),
        ("--checkpoint-every 0", "--checkpoint-every must be at least 1"),
        ("--threads 0", "--threads must be at least 1"),
        ("--threads 1000000", "--threads must be at most 256"),
        ("--name a/b", "--name must be a plain directory name"),
        ("--name=" + "x" * 300, "--name must have at most 200 bytes"),
        ("--seeds 3-1", "--seeds must be a list"),
        ("--seeds 1,x", "--seeds must be a list"),
        ("--seeds 1,1", "--seeds must be a list"),
        ("--seeds 0-99999999999999", "--seeds must be a list"),
        ("--seeds 0-3 --seed 7", "--seed and --seeds exclude each other"),
        ("--seeds 0-3 --workers 0", "--workers must be at least 1"),
        ("--resume nowhere", "not a run directory"),
        ("--again nowhere", "cannot be read"),
        ("--runs /dev/null", "cannot be used"),
        ("--trials " + "9" * 400, "--trials must lie between -2**63 and 2**63"),
    ],
)
def test_bad_flags_get_one_clear_line_and_leave_nothing(words, message, here, capsys):
    assert message in bad(words.split(), capsys)
    assert not contents(here)


@pytest.mark.parametrize(
    "words,message",
    [
        ("--net.theta 0.77", "--net.theta 0.77 contradicts"),
        ("--seed 5", "--seed 5 contradicts"),
        ("--agent q", "--agent q contradicts"),
        ("--pose true", "--pose true contradicts"),
        ("--trials 1", "has 2 trials already"),
        ("--name other", "--name is for new runs"),
        ("--runs other", "--runs is for new runs"),
        ("--workers 2", "--workers has no effect without --seeds"),
        ("--seeds 0-3", "--resume goes with neither"),
        ("--again x", "--resume goes with neither"),
    ],
)
def test_a_resumed_run_keeps_its_settings(words, message, run, capsys):
    before = contents(run)
    assert message in bad(["--resume", str(run), *words.split()], capsys)
    assert contents(run) == before


def test_a_name_of_two_lines_is_refused(here, capsys):
    assert "--name must be a plain directory name" in bad(["--name", "a\nb"], capsys)


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b'{"config": 3}', b"\xff\xfe", b"[" * 100_000])
def test_unreadable_settings_get_one_clear_line(data, run, capsys):
    (run / "config.json").write_bytes(data)
    before = contents(run)
    assert "config.json" in bad(["--resume", str(run)], capsys)
    assert contents(run) == before


def test_a_directory_that_is_no_run_is_left_alone(here, capsys):
    Path("documents").mkdir()
    Path("documents/letter.txt").write_text("dear")
    before = contents(here)
    assert "not a run directory" in bad(["--resume", "documents"], capsys)
    assert contents(here) == before


def test_a_damaged_checkpoint_gets_one_clear_line(run, capsys):
    path = run / "checkpoint-2.pt"
    path.write_bytes(path.read_bytes()[:-1])
    before = contents(run)
    line = bad(["--resume", str(run), "--trials", "3"], capsys)
    assert "damaged or cut off" in line and "checkpoint-0.pt" in line
    assert contents(run) == before


# ------------------------------------------------------------------------------------ many seeds


@pytest.mark.slow
def test_several_seeds_in_one_call(here, capsys):
    assert main(["--seeds", "0,2", "--workers", "2", "--trials", "2", *QUICK]) == 0
    for seed in (0, 2):
        run = Path(f"runs/sga-sofnn-estimated-s{seed}")
        assert load_config(run).seed == seed
        assert checkpoint.find_latest(run)[1]["trial"] == 2
    assert not Path("runs/sga-sofnn-estimated-s1").exists()


def test_a_crash_of_one_seed_leaves_the_others(here, capsys, monkeypatch):
    """The process of one seed is killed as soon as its run is there."""
    real = jobs.subprocess.Popen

    def popen(command, **keywords):
        child = real(command, **keywords)
        if command[-1].endswith("-s1"):
            child.kill()
        return child

    monkeypatch.setattr(jobs.subprocess, "Popen", popen)
    assert main(["--seeds", "0-1", "--workers", "2", "--trials", "1", *QUICK]) == 1
    out, err = capsys.readouterr()
    assert out == "runs/sga-sofnn-estimated-s0: done\n"
    assert "seed 1: exit code -9" in err and "1 of 2" in err
    assert checkpoint.find_latest(Path("runs/sga-sofnn-estimated-s0"))[1]["trial"] == 1


def test_a_signal_stops_all_seeds_after_saving(here, capsys):
    run = Path("runs/sga-sofnn-estimated-s0")

    def stop_it():
        deadline = time.monotonic() + 300
        while not (run / "trials.csv").exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=stop_it).start()
    words = ["--seeds", "0-3", "--workers", "1", "--trials", "100000", *QUICK]
    assert main(words) == 128 + signal.SIGTERM
    assert f"--resume {run}" in capsys.readouterr().err
    state = checkpoint.find_latest(run)[1]
    assert state["trial"] == len((run / "trials.csv").read_text().splitlines()) - 1 > 0
    assert [path.name for path in Path("runs").iterdir()] == [run.name]


@pytest.mark.parametrize(
    "text,expected", [("0-3", [0, 1, 2, 3]), ("5", [5]), ("0,3,5-6", [0, 3, 5, 6])]
)
def test_lists_of_seeds(text, expected):
    assert parallel.parse(text) == expected


# ------------------------------------------------------------------------------------------- fuzz

plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda parts: (
        st.lists(parts, max_size=3) | st.dictionaries(st.text(max_size=8), parts, max_size=3)
    ),
    max_leaves=5,
)


def places(tree, place=()):
    for key, part in tree.items():
        yield (*place, key)
        if isinstance(part, dict):
            yield from places(part, (*place, key))


PLACES = sorted(places(asdict(Config())))


def with_value(tree, place, value):
    head, *rest = place
    return {**tree, head: with_value(tree[head], rest, value) if rest else value}


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(PLACES), plain | st.sampled_from(["sga", "q", "fixed", 0.5, 1, -1, 10**30]))
@example(("net", "theta"), float("nan"))
@example(("net", "grid"), [1, 2])
@example(("q", "trace_limit"), None)
@example(("seed",), True)
def test_any_settings_are_valid_or_refused_in_one_line(place, value):
    data = with_value(asdict(Config()), place, value)
    try:
        config = from_dict(data)
    except ValueError as error:
        assert "\n" not in str(error) and len(str(error)) < 300
        return
    assert from_dict(json.loads(config.to_json())) == config


@settings(max_examples=100, deadline=None)
@given(st.sampled_from(PLACES), st.integers(-3, 3) | st.floats(-10, 10))
def test_valid_settings_make_an_agent_or_are_refused_in_one_line(place, value):
    try:
        make_agent(from_dict(with_value(asdict(Config()), place, value)))
    except ValueError as error:
        assert "\n" not in str(error)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=60) | plain.map(lambda value: json.dumps({"config": value}).encode()))
def test_any_config_file_is_refused_in_one_line(data):
    with tempfile.TemporaryDirectory() as directory:
        Path(directory, "config.json").write_bytes(data)
        try:
            assert isinstance(load_config(Path(directory)), Config)
        except ValueError as error:
            assert str(error).startswith(directory) and "\n" not in str(error)


FLAGS = ["--agent", "--net.theta", "--trials", "--seeds", "--q.gamma", "--name", "--net.grid"]
VALUES = ["q", "sga", "0.5", "3", "-1", "nan", "None", "--", "--quiet", "=", "--net.theta=0.3"]
words = st.sampled_from(FLAGS + VALUES) | st.text(max_size=6)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(words, max_size=4).filter(lambda ws: not {"-h", "--help"} & set(ws)))
def test_any_arguments_are_parsed_or_refused_in_one_line(arguments):
    try:
        assert isinstance(parse(arguments), cli.Flags)
    except ValueError as error:
        assert "\n" not in str(error).strip()


def test_a_config_survives_its_file(tmp_path):
    config = short("q", "fixed", q={"trace_limit": None}, net={"grid": (3, 5, 7)}, trials=1)
    assert load_config(training.train(config, quick_options(tmp_path))) == config


def test_the_largest_seed_can_be_read_again():
    config = Config(seed=2**63 - 1)
    assert from_dict(json.loads(config.to_json())) == config
