"""What the infrared sensors feel, against rays followed step by step and against MuJoCo."""

import math

import numpy as np
import pytest

from sofnn_torch.maze.env import STRAIGHT, KheperaMazeEnv
from sofnn_torch.maze.odometry import ROBOT_RADIUS, DeadReckoning, MotorNoise, squared, wrap_angle
from sofnn_torch.maze.robot import Physics
from sofnn_torch.maze.sensors import INFRARED, INFRARED_RANGE, apart, felt_walls, readings

FORWARD, TURN_LEFT = (0.01, 0.01), (-0.004, 0.004)
QUARTER = 0.5 * math.pi


def marched(walls, step=1e-5):
    """Free distances before the sensors; `walls` are directions and distances from the centre."""
    seen = []
    for x, y, angle in INFRARED.values():
        way = np.arange(0.0, INFRARED_RANGE + step, step)
        px = x + way * math.cos(math.radians(angle))
        py = y + way * math.sin(math.radians(angle))
        hit = np.zeros(len(way), dtype=bool)
        for bearing, distance in walls:
            hit |= px * math.cos(bearing) + py * math.sin(bearing) >= distance
        seen.append(float(way[hit.argmax()]) if hit.any() else INFRARED_RANGE)
    return seen


@pytest.mark.parametrize("degrees", range(-80, 81, 10))
def test_a_flat_wall_is_felt_where_it_is(degrees):
    bearing = math.radians(degrees)
    (felt,) = felt_walls(marched([(bearing, ROBOT_RADIUS)]))
    assert felt == pytest.approx(bearing, abs=2e-3)
    assert felt_walls(marched([(bearing, ROBOT_RADIUS + 0.002)])) == []
    assert felt_walls(marched([(bearing, ROBOT_RADIUS)]), forward=-1.0) == []  # it drives away


@pytest.mark.parametrize("degrees", [-170, -130, 150])
def test_a_wall_behind_is_felt_by_a_robot_that_backs_into_it(degrees):
    seen = marched([(math.radians(degrees), ROBOT_RADIUS)])
    assert felt_walls(seen) == []
    (felt,) = felt_walls(seen, forward=-1.0)
    assert apart(felt, math.radians(degrees)) < 2e-3


@pytest.mark.parametrize("degrees", [0, 20, 45, 70])
def test_both_walls_of_a_corner_are_felt(degrees):
    one, other = math.radians(degrees), math.radians(degrees) - QUARTER
    felt = felt_walls(marched([(one, ROBOT_RADIUS), (other, ROBOT_RADIUS)]))
    expected = [w for w in (one, other) if math.cos(w) > 0.05]  # along the other it drives
    assert sorted(felt) == pytest.approx(sorted(expected), abs=5e-3)


def test_readings_are_noisy_in_proportion_and_end_at_the_range():
    ranges = [0.0, 0.01, 0.02, 0.0499, 0.05, 0.05, 0.05, 0.05]
    assert readings(ranges, 0.0, [0.9] * 8) == ranges
    assert readings(ranges, 0.1, [1.0] * 8) == pytest.approx([0, 0.011, 0.022, *[0.05] * 5])
    assert readings(ranges, 0.1, [0.0] * 8) == pytest.approx(
        [0, 0.009, 0.018, 0.04491, *[0.05] * 4]
    )


def test_noise_of_a_tenth_moves_a_felt_wall_by_a_few_degrees():
    rng = np.random.default_rng(0)
    errors = []
    for bearing in np.radians(rng.uniform(-75, 75, 400)):
        noisy = readings(marched([(bearing, ROBOT_RADIUS)], 1e-4), 0.1, rng.random(8).tolist())
        errors += [apart(felt, bearing) for felt in felt_walls(noisy)]
    assert len(errors) >= 380  # of 400; in the others the noise moves the wall away
    assert np.quantile(np.degrees(errors), 0.95) < 4.0


def test_bumps_are_felt_where_the_simulation_has_contacts():
    physics, noise, rng = Physics(), MotorNoise(), np.random.default_rng(3)
    counts = {(touched, felt): 0 for touched in (False, True) for felt in (False, True)}
    bearings = []
    for _ in range(60):
        place = rng.uniform(0.05, 0.95, 2).tolist()
        while not physics.plan.has_room(*place):
            place = rng.uniform(0.05, 0.95, 2).tolist()
        physics.place((*place, rng.uniform(-3, 3)))
        for _ in range(60):
            physics.drive(*noise.apply(*FORWARD, *rng.random(2).tolist()))
            felt = felt_walls(readings(physics.infrared_ranges(), 0.1, rng.random(8).tolist()))
            counts[physics.bumped(), bool(felt)] += 1
            if felt and physics.bumped():
                bearings.append(min(apart(felt[0], wall) for wall in physics.wall_bearings()))
    touched = counts[True, True] + counts[True, False]
    assert touched > 500
    assert counts[True, True] / touched > 0.9
    assert counts[False, True] / (counts[False, True] + counts[False, False]) < 0.03
    assert np.median(np.degrees(bearings)) < 1.5


def test_turning_on_the_spot_is_no_bump():
    env = KheperaMazeEnv(motor_noise=0.0, infrared_noise=0.0)
    env.reset(options={"pose": (0.9715, 0.15, 0.0)})
    assert env.step(STRAIGHT)[4]["collision"]
    for turn in (0, 2):
        assert not env.step(turn)[4]["collision"]


def test_the_robot_moves_alike_whatever_it_feels():
    poses = []
    for noise in (0.0, 0.5):
        env = KheperaMazeEnv(infrared_noise=noise, hold=1)
        env.reset(seed=0, options={"pose": (0.9, 0.15, 0.1)})
        poses.append([env.step(STRAIGHT)[4]["true_pose"] for _ in range(40)])
    np.testing.assert_array_equal(*poses)


def test_a_felt_wall_corrects_the_heading_by_a_share():
    # It heads to the north-east by 0.1 rad too far; the wall in the east is felt where it is.
    assert squared(0.885, -0.785) == pytest.approx(0.885 - 0.3 * 0.1, abs=1e-9)
    assert squared(-3.1, wrap_angle(3.1 - 0.05)) == pytest.approx(-3.1 + 0.3 * 0.05)
    assert squared(0.4, 0.0) == 0.4  # 23 degrees off: the edge of a wall, not one along x or y
    estimator = DeadReckoning(right_angles=True)
    estimator.fix((0.5, 0.5, 0.1))
    for _ in range(20):
        estimator.update(0.0, 0.0, [0.0])
    assert estimator.pose[2] == pytest.approx(0.1 * 0.7**20)


def test_right_angles_keep_the_heading_of_a_robot_that_bumps():
    errors = {}
    for knows in (False, True):
        found = []
        for seed in range(3):
            env = KheperaMazeEnv(right_angles=knows, max_steps=3000)
            _, info = env.reset(seed=seed)
            rng, over = np.random.default_rng(seed), False
            while not over:
                _, _, terminated, over, info = env.step(rng.choice(3, p=[0.25, 0.5, 0.25]))
                over = over or terminated
                found.append(apart(info["true_pose"][2], info["estimated_pose"][2]))
        errors[knows] = math.degrees(np.mean(found))
    assert errors[True] < 1.5 < 1.5 * errors[True] < errors[False]
