"""The closed loop of examples/robot: an exported policy drives a robot by lines of text."""

import math
import runpy
import socket
import threading
from pathlib import Path

import pytest
from exported import learner

from sofnn_torch.export import policy, runtime
from sofnn_torch.runs.factory import make_agent
from sofnn_torch.runs.settings import Config

ROBOT = Path(__file__).parents[1] / "examples" / "robot"


@pytest.fixture
def parts(monkeypatch):
    """What simulated.py and drive.py define."""
    monkeypatch.syspath_prepend(str(ROBOT))
    return runpy.run_path(str(ROBOT / "simulated.py")) | runpy.run_path(str(ROBOT / "drive.py"))


@pytest.fixture
def east():
    """A policy of one rule that goes straight on, which is east from the start."""
    config, agent = learner("three", rules=1)
    data = policy.describe(config, agent)
    data["rules"][0]["consequents"][0] = 0.0
    return data


def test_a_policy_drives_over_a_socket_and_knows_where_it_is(parts, east):
    here, there = socket.socketpair()
    robot = parts["SimulatedRobot"](seed=1)
    served = threading.Thread(target=parts["serve"], args=(there, robot))
    served.start()
    with here:
        driver = parts["Driver"](runtime.Policy(east, seed=0), parts["over"](here))
        assert driver.trial(limit=120) is None  # of 5 mm: the goal is in the north
        here.shutdown(socket.SHUT_RDWR)
    served.join()
    x, y, _ = robot.physics.pose()
    assert 0.6 < x < 0.9 and abs(y - 0.15) < 0.03
    assert driver.place.pose[:2] == pytest.approx((x, y), abs=0.02)
    assert robot.steps == 120


def test_ten_rules_by_hand_arrive_by_encoders_infrared_and_marks(parts):
    rules = ROBOT.parent / "rules" / "sga.csv"
    config = Config(rules=rules)
    data = policy.describe(config, make_agent(config))
    steps = []
    for seed in range(3):
        robot = parts["SimulatedRobot"](seed=seed)
        steps.append(parts["Driver"](runtime.Policy(data, seed), robot.answer).trial(1000))
    arrived = [count for count in steps if count is not None]
    assert len(arrived) >= 2 and max(arrived) < 650, steps
    assert robot.physics.plan.goal_radius >= math.dist(
        robot.physics.position(), robot.physics.plan.goal
    )


@pytest.mark.parametrize(
    ("fault", "metres"),
    [
        ({"lost": 0.4}, 0.3),
        ({"late": 0.25}, 0.3),
        ({"radius": 1.1}, 0.33),
        ({"radius": 0.9}, 0.27),
        ({}, 0.3),
    ],
    ids=str,
)
def test_faults_do_to_the_robot_what_they_are_called(parts, fault, metres):
    robot = parts["SimulatedRobot"](parts["Faults"](**fault), seed=2)
    robot.noise.magnitude = 0.0
    robot.answer("start")
    before = robot.physics.position()[0]
    answers = [robot.answer("0.01 0.01") for _ in range(60)]
    moved = robot.physics.position()[0] - before
    assert moved == pytest.approx(metres, abs=0.02 if "lost" in fault else 0.006)
    silent = sum(not answer for answer in answers) / 60
    assert silent == pytest.approx(fault.get("lost", 0), abs=0.2)
    last = [float(word) for word in next(a for a in answers[::-1] if a).split()[:2]]
    believed = moved / fault.get("radius", 1)
    assert last == pytest.approx([believed] * 2, abs=0.02)  # what it believes it has driven


def test_a_weak_motor_and_a_wide_base_turn_the_robot(parts):
    def heading(line, **fault):
        robot = parts["SimulatedRobot"](parts["Faults"](**fault))
        robot.noise.magnitude = 0.0
        robot.answer("start")
        for _ in range(10):
            robot.answer(line)
        return robot.physics.pose()[2]

    turned = heading("-0.004 0.004")
    assert turned == pytest.approx(0.8, abs=0.04)
    assert heading("-0.004 0.004", base=1.1) == pytest.approx(turned / 1.1, abs=0.02)
    assert heading("0.01 0.01", left=0.9) == pytest.approx(0.1, abs=0.02)


def test_a_wrong_call_is_one_line(parts, tmp_path, east, monkeypatch):
    path = tmp_path / "policy.json"
    path.write_bytes(policy.to_json(east))
    cut = tmp_path / "cut.json"
    cut.write_bytes(path.read_bytes()[:200])
    for given, said in (
        ([], "usage"),
        ([cut, "127.0.0.1:1"], "not JSON"),
        ([path, "127.0.0.1:1"], "refused"),
        ([path, tmp_path / "none"], "none"),
    ):
        monkeypatch.setattr("sys.argv", ["drive.py", *map(str, given)])
        with pytest.raises(SystemExit, match=said) as stop:
            parts["main"]()
        assert "\n" not in str(stop.value)
