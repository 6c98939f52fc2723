"""A run that is killed and resumed ends as one that never stopped, to the last bit."""

import contextlib
import json
import random
import signal
import time
import urllib.request
from dataclasses import replace

import doomed
import pytest
from conftest import assert_same_run, quick_options, settings
from tensorboard import program

from sofnn_torch.runs.places import default_name
from sofnn_torch.runs.signals import NUMBERS

# Both learners on a growing network, with every kind of pose.
GROWING = {
    f"{agent} {pose}": settings(agent, pose=pose, trials=12)
    for agent in ("sga", "q")
    for pose in ("estimated", "true", "odometry")
}
QUICK = {"sga estimated": doomed.MOMENTS, "q odometry": ("decision",)}  # by default
# Also fixed networks, learned antecedents, every action type, a second block, the rule limit.
CASES = GROWING | {
    "sga-antecedents": settings(
        pose="odometry",
        trials=6,
        net={"growth": "input", "theta": 0.7},
        sga={"rate_centre": 0.01, "rate_width": 0.01},
        maze={"actions": "wheels"},
    ),
    "q-antecedent": settings(
        "q", trials=6, q={"coding": "antecedent", "rate_centre": 1e-4, "rate_width": 1e-4}
    ),
    "q-fixed": settings("q", "fixed", pose="odometry", trials=6),
    "sga-literal": settings(
        trials=6, maze={"dead_reckoning": "literal", "wheel_noise": "independent"}
    ),
    "sga-two-blocks": settings(
        trials=3, maze={"max_steps": 6000}, net={"theta": 0.9, "width_position": 0.01}
    ),
    "q-to-the-goal": settings("q", trials=3, maze={"max_steps": 20_000}),
    "q-at-the-cap": settings("q", trials=6, net={"max_rules": 10}),
}


@pytest.fixture(scope="module")
def references(tmp_path_factory):
    """Uninterrupted runs by case, made when first asked for, with their counts of moments."""
    made = {}

    def reference(case):
        if case not in made:
            runs = tmp_path_factory.mktemp(case)
            run = runs / default_name(CASES[case])
            made[case] = run, doomed.count_moments(CASES[case], quick_options(runs), run)
        return made[case]

    return reference


def live_through(case, tmp_path, moments, number=signal.SIGKILL):
    """Train, die at each moment in turn, resume until done; run directory and exit codes."""
    config, options = CASES[case], quick_options(tmp_path)
    run = tmp_path / default_name(config)
    codes = [doomed.finish(doomed.start(config, options, run, m, number)) for m in moments]
    assert doomed.finish(doomed.start(config, options, run)) == 0
    return run, codes


def assert_same_end(run, reference):
    assert_same_run(run, reference)
    assert not list(run.glob(".*")) and not list(run.glob("*.unused"))


def random_moment(counts, *key):
    """A moment of a kind, key[-2], drawn anew for every key but alike in every call."""
    kind = key[-2]
    return kind, random.Random(str(key)).randint(1, counts[kind])


def assert_one_death_does_no_harm(case, kind, point, references, tmp_path):
    reference, counts = references(case)
    run, codes = live_through(case, tmp_path, [random_moment(counts, case, kind, point)])
    assert codes == [-signal.SIGKILL]
    assert_same_end(run, reference)


@pytest.mark.parametrize(
    "case,kind",
    [
        pytest.param(case, kind, marks=[pytest.mark.slow] * (kind not in QUICK.get(case, ())))
        for case in GROWING
        for kind in doomed.MOMENTS
    ],
)
def test_a_killed_run_resumes_bit_for_bit(case, kind, references, tmp_path):
    assert_one_death_does_no_harm(case, kind, 0, references, tmp_path)


def assert_a_signal_does_no_harm(case, number, kind, point, references, tmp_path):
    reference, counts = references(case)
    moment = random_moment(counts, case, number, kind, point)
    run, codes = live_through(case, tmp_path, [moment], number)
    # In the last decision of all, or in the files written after it, all is done.
    done = codes == [0] and (kind != "decision" or moment[1] == counts[kind])
    assert done or codes == [128 + number], moment
    assert_same_end(run, reference)


@pytest.mark.parametrize(
    "number,kind",
    [
        *((n, "decision") for n in (signal.SIGINT, signal.SIGTERM)),
        *((signal.SIGTERM, kind) for kind in ("file", "fsync")),
        *(pytest.param(n, "decision", marks=pytest.mark.slow) for n in NUMBERS[2:]),
    ],
)
def test_a_signal_saves_the_run_and_resume_goes_on_bit_for_bit(number, kind, references, tmp_path):
    assert_a_signal_does_no_harm("sga estimated", number, kind, 0, references, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("point", range(1, 9))
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("kind", ["decision", "file", "fsync"])
@pytest.mark.parametrize("case", ["sga estimated", "q true", "q-at-the-cap"])
def test_a_signal_at_any_moment(case, kind, number, point, references, tmp_path):
    assert_a_signal_does_no_harm(case, number, kind, point, references, tmp_path)


def test_a_run_killed_again_and_again_resumes_bit_for_bit(references, tmp_path):
    reference, _ = references("sga estimated")
    moments = [("decision", 40), ("half written", 4), ("fsync", 3), ("decision", 15)]
    run, codes = live_through("sga estimated", tmp_path, moments)
    assert codes == [-signal.SIGKILL] * 4
    assert_same_end(run, reference)


def assert_two_deaths_do_no_harm(kind, first, second, references, tmp_path):
    reference, _ = references("sga estimated")
    moments = [(kind, first), (kind, second)]
    runs = tmp_path / f"{kind} {first} {second}"
    assert_same_end(live_through("sga estimated", runs, moments)[0], reference)


@pytest.mark.parametrize("kind,first,second", [("file", 5, 13), ("fsync", 3, 5)])
def test_a_run_killed_twice_at_its_beginning(kind, first, second, references, tmp_path):
    """Before the first checkpoint, and again before the second."""
    assert_two_deaths_do_no_harm(kind, first, second, references, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("first", range(1, 10))
@pytest.mark.parametrize("kind", ["file", "fsync", "half written"])
def test_a_run_killed_at_any_two_early_moments(kind, first, references, tmp_path):
    for second in range(1, 16):
        assert_two_deaths_do_no_harm(kind, first, second, references, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("point", range(1, 7))
@pytest.mark.parametrize("kind", doomed.MOMENTS)
@pytest.mark.parametrize("case", CASES)
def test_any_kill_point(case, kind, point, references, tmp_path):
    assert_one_death_does_no_harm(case, kind, point, references, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_kills_by_the_clock(case, references, tmp_path):
    """The kill comes from outside, after a random time, until the run is done."""
    reference, _ = references(case)
    config, options = replace(CASES[case]), quick_options(tmp_path)
    run, clock, kills = tmp_path / default_name(config), random.Random(case), 0
    while True:
        child = doomed.start(config, options, run)
        time.sleep(clock.uniform(0.02, 0.3) * 1.05**kills)  # also on a slow machine
        child.kill()
        code = doomed.finish(child)
        if code == 0:
            break
        assert code == -signal.SIGKILL
        kills += 1
        assert kills < 100
    assert kills
    assert_same_end(run, reference)


@pytest.mark.slow
def test_tensorboard_shows_one_curve_without_doubled_steps(references, tmp_path):
    """In the page itself, with the data server that its installation has."""
    _, counts = references("sga estimated")
    moment = ("decision", counts["decision"])  # in trial 12: 11 is shown, but only 10 is saved
    run, codes = live_through("sga estimated", tmp_path, [moment])
    files = sorted(run.glob("events.*"))
    assert codes == [-signal.SIGKILL] and len(files) == 2
    board = program.TensorBoard()
    board.configure(argv=["tensorboard", "--logdir", str(tmp_path), "--port", "0"])
    page = f"{board.launch()}data/plugin/scalars/scalars?run={run.name}&tag=trial%2Fsteps"
    curve, deadline = [], time.monotonic() + 120
    while len(curve) < 12 and time.monotonic() < deadline:
        time.sleep(0.5)
        with contextlib.suppress(OSError, ValueError):
            curve = json.loads(urllib.request.urlopen(page).read())
    assert [trial for _, trial, _ in curve] == [*range(1, 13)]
