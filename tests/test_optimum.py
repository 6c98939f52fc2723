"""The shortest run through the maze."""

import dataclasses
import math
import subprocess
import sys

import numpy as np
import pytest

from sofnn_torch.maze import optimum
from sofnn_torch.maze.env import KheperaMazeEnv
from sofnn_torch.maze.optimum import STEP_LENGTH, STEP_TURN, optimal_steps
from sofnn_torch.maze.plan import MazePlan
from sofnn_torch.maze.robot import Physics

SKIN = 0.001 - 0.0004  # m, kept from walls, less the error of the grid that says where they are


@pytest.fixture(scope="module")
def plan():
    return Physics().plan


@pytest.fixture(scope="module")
def held(plan):
    return optimal_steps(plan)


def room(start, goal, walls=()):
    """Return a 1 m x 1 m room."""
    south, north = (-0.1, -0.1, 1.1, 0.0), (-0.1, 1.0, 1.1, 1.1)
    west, east = (-0.1, 0.0, 0.0, 1.0), (1.0, 0.0, 1.1, 1.0)
    return MazePlan(
        size=(1.0, 1.0),
        walls=[south, north, west, east, *walls],
        starts=[start],
        goals=[goal],
        goal_radius=0.06,
        subgoals=[],
        subgoal_radius=0.08,
        start_radius=0.08,
        robot_radius=0.0275,
    )


@pytest.mark.parametrize("hold", [1, 10])
def test_a_goal_straight_ahead(hold):
    best = optimal_steps(room((0.2, 0.5, 0.0), (0.602, 0.5)), hold, 0.005)
    assert best.steps == math.ceil((0.402 - 0.06) / STEP_LENGTH)
    assert set(best.actions) == {1}


def test_a_goal_behind_needs_a_half_turn():
    # At least 180 degrees less what the goal's width forgives, and the way to its edge.
    best = optimal_steps(room((0.6, 0.5, 0.0), (0.2, 0.5)), 1, 0.0025)
    turns = (math.pi - math.asin(0.06 / 0.4)) / STEP_TURN
    assert turns + 68 <= best.steps <= math.pi / STEP_TURN + 69
    assert len(best.actions) == best.steps


def test_an_unreachable_goal_is_an_error():
    wall = (0.5, 0.0, 0.52, 1.0)
    with pytest.raises(ValueError, match="cannot be reached"):
        optimal_steps(room((0.2, 0.5, 0.0), (0.8, 0.5), [wall]), 10, 0.01)


def test_the_help_is_that_of_the_command():
    command = [sys.executable, "-m", "sofnn_torch.maze.optimum", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and "-m sofnn_torch.maze.optimum" in done.stdout.splitlines()[0]


def test_unknown_flags_are_refused(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["optimum", "--foo"])
    with pytest.raises(SystemExit) as stop:
        optimum.main()
    assert stop.value.code == 2
    assert capsys.readouterr().err.startswith("error: Unrecognized options: --foo")


def test_the_papers_516_steps_are_110_percent_of_the_optimum(held):
    assert 1.10 <= 515.9 / held.steps <= 1.12
    assert held.steps == 468


def test_the_held_optimum_does_not_depend_on_the_resolution(plan, held):
    for resolution in (0.01, 0.005):  # `held` is finer
        assert optimal_steps(plan, 10, resolution).steps == held.steps


@pytest.mark.slow
def test_free_actions_are_faster(plan, held):
    assert optimal_steps(plan, 1, 0.0025).steps < 0.92 * held.steps


def test_the_path_is_driven_by_its_actions_and_touches_nothing(plan, held):
    x, y, heading = plan.start
    steps = 0
    for action, pose in zip(held.actions, held.path, strict=False):
        assert pose == pytest.approx((x, y, heading))
        assert plan.clearance(x, y) > SKIN
        for _ in range(min(10, held.steps - steps)):
            heading += STEP_TURN * (action - 1)
            x += STEP_LENGTH * math.cos(heading) * (action == 1)
            y += STEP_LENGTH * math.sin(heading) * (action == 1)
            assert plan.clearance(x, y) > SKIN
            steps += 1
    assert held.path[-1] == pytest.approx((x, y, heading))
    assert steps == held.steps and len(held.path) == len(held.actions) + 1
    assert math.dist((x, y), plan.goal) <= plan.goal_radius


def test_the_simulated_robot_needs_as_many_steps(held):
    env = KheperaMazeEnv(pose="true", motor_noise=0.0)
    env.reset(seed=0)
    results = [env.step(action) for action in held.actions]
    assert results[-1][2] and not any(result[4]["collision"] for result in results)
    assert results[-1][4]["total_steps"] == pytest.approx(held.steps, rel=0.01)
    driven = np.array([result[4]["true_pose"][:2] for result in results])
    planned = np.array(held.path)[1:, :2]
    assert np.linalg.norm(driven - planned, axis=1)[:-1].max() < 0.002


def test_a_wider_gap_is_a_shortcut(plan, held):
    x0, y0, x1, y1 = plan.walls[4]
    wider = [*plan.walls[:4], (x0, y0, x1 - 0.05, y1), plan.walls[5]]
    assert optimal_steps(dataclasses.replace(plan, walls=wider), 10, 0.005).steps < held.steps
