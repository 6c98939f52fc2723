"""Motor noise and dead reckoning."""

import math

import mujoco
import numpy as np
import pytest

from sofnn_torch.maze.env import LEFT, RIGHT, STRAIGHT, KheperaMazeEnv
from sofnn_torch.maze.layouts import standard_path
from sofnn_torch.maze.odometry import (
    DRAG,
    FORWARD_SPEED,
    ROBOT_RADIUS,
    STEP_LENGTH,
    DeadReckoning,
    MotorNoise,
    advance,
    differential_drive,
    slide,
    wrap_angle,
)
from sofnn_torch.maze.robot import Physics
from sofnn_torch.maze.spaces import motion, wheel_speeds

QUARTER = 0.5 * math.pi


def test_angles_are_wrapped_into_a_half_open_circle():
    angles = np.linspace(-20.0, 20.0, 999)
    wrapped = np.array([wrap_angle(angle) for angle in angles])
    assert (wrapped >= -math.pi).all() and (wrapped < math.pi).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-12)
    assert wrap_angle(math.pi) == -math.pi
    just_outside = math.nextafter(-math.pi, -4.0)
    assert -math.pi <= wrap_angle(just_outside) < math.pi


def test_common_noise_is_that_of_the_khepera_simulator():
    noise = MotorNoise(0.1)
    draws = np.random.default_rng(0).random((100_000, 2)).tolist()
    straight = np.array([noise.apply(0.01, 0.01, *draw) for draw in draws]) / 0.01
    assert (straight[:, 0] == straight[:, 1]).all()  # a straight run does not change its heading
    # Factors U(0.9, 1.1) and U(0.95, 1.05) have the standard deviations 0.0577 and 0.0289.
    assert straight.mean() == pytest.approx(1.0, abs=1e-3)
    assert straight.std() == pytest.approx(0.0577, rel=0.01)
    assert 0.9 <= straight.min() < 0.901 and 1.099 < straight.max() <= 1.1

    turning = np.array([noise.apply(-0.004, 0.004, *draw) for draw in draws]) / 0.004
    np.testing.assert_allclose(turning[:, 0], -turning[:, 1])
    assert turning[:, 1].mean() == pytest.approx(1.0, abs=1e-3)
    assert turning[:, 1].std() == pytest.approx(0.0289, rel=0.01)
    assert 0.95 <= turning[:, 1].min() < 0.951 and 1.049 < turning[:, 1].max() <= 1.05


def test_independent_noise_acts_on_each_wheel():
    noise = MotorNoise(0.1, "independent")
    draws = np.random.default_rng(0).random((100_000, 2)).tolist()
    factors = np.array([noise.apply(0.01, -0.004, *draw) for draw in draws]) / [0.01, -0.004]
    np.testing.assert_allclose(factors.mean(axis=0), 1.0, atol=1e-3)
    np.testing.assert_allclose(factors.std(axis=0), 0.0577, rtol=0.01)
    assert abs(np.corrcoef(factors.T)[0, 1]) < 0.02


def test_steps_have_the_khepera_simulators_constants():
    # Its manual: motor values (10, 10) move 5 mm a step; (-4, 4) turn 2 x 8 / 200 rad.
    assert differential_drive(0.005, 0.005, 0.050) == pytest.approx((0.005, 0.0))
    assert differential_drive(-0.002, 0.002, 0.050) == pytest.approx((0.0, 0.08))


def test_dead_reckoning_by_hand():
    estimator = DeadReckoning()
    estimator.fix((0.15, 0.25, 0.0))
    for _ in range(10):
        estimator.update(0.005, 0.005)
    assert estimator.pose == pytest.approx((0.2, 0.25, 0.0))
    for _ in range(10):
        estimator.update(-0.002, 0.002)
    assert estimator.pose == pytest.approx((0.2, 0.25, 0.8))
    for _ in range(10):
        estimator.update(0.005, 0.005)
    x, y = 0.2 + 0.05 * math.cos(0.8), 0.25 + 0.05 * math.sin(0.8)
    assert estimator.pose == pytest.approx((x, y, 0.8))


def test_dead_reckoning_follows_an_arc():
    # A quarter circle of radius 100 mm in 100 steps; the chords are 2e-5 short of the arc.
    pose = (0.5, 0.5, 0.0)
    for _ in range(100):
        pose = advance(pose, 0.1 * QUARTER / 100, QUARTER / 100)
    assert pose == pytest.approx((0.6, 0.6, QUARTER), abs=1e-5)


@pytest.mark.parametrize("mode", ["slide", "still"])
def test_an_estimate_waits_at_walls_and_stays_inside(mode):
    estimator = DeadReckoning(mode, arena=(1.0, 0.8))
    estimator.fix((0.5, 0.5, 0.0))
    estimator.update(0.005, 0.005, [0.0])
    assert estimator.pose == pytest.approx((0.5, 0.5, 0.0))
    estimator.update(-0.002, 0.002, [0.0])  # a robot at a wall still turns
    assert estimator.pose == pytest.approx((0.5, 0.5, 0.08))
    estimator.fix((0.972, 0.772, 0.25 * math.pi))
    estimator.update(0.005, 0.005)
    assert estimator.pose[:2] == (1.0 - ROBOT_RADIUS, 0.8 - ROBOT_RADIUS)


def test_an_estimate_slides_along_a_wall():
    estimator = DeadReckoning("slide")
    estimator.fix((0.5, 0.5, 0.25 * math.pi))  # to the north-east, against a wall in the east
    estimator.update(0.005, 0.005, [-0.25 * math.pi])
    way = 0.005 * math.sqrt(0.5) / (0.5 + 0.5 * DRAG)
    assert estimator.pose == pytest.approx((0.5, 0.5 + way, 0.25 * math.pi))
    before = estimator.pose
    estimator.update(0.005, 0.005, [-0.25 * math.pi, -0.25 * math.pi])  # two pieces of one wall
    assert estimator.pose[1] - before[1] == pytest.approx(way)
    estimator.update(0.005, 0.005, [-0.25 * math.pi, 0.25 * math.pi])  # a corner
    estimator.update(-0.005, -0.005, [0.0])  # away from the wall
    x, y = 0.5 - 0.005 * math.sqrt(0.5), 0.5 + 2 * way - 0.005 * math.sqrt(0.5)
    assert estimator.pose[:2] == pytest.approx((x, y))


def test_the_heading_of_an_estimate_is_wrapped_also_at_a_wall():
    estimator = DeadReckoning()
    estimator.fix((0.5, 0.5, math.pi - 0.01))
    estimator.update(-0.002, 0.002, [0.0])
    assert estimator.pose[2] == pytest.approx(-math.pi + 0.07)


def test_an_estimate_stands_still_in_a_corner_as_the_robot_does():
    env = KheperaMazeEnv(bumps="contact", right_angles=False, motor_noise=0.0)
    env.reset(options={"pose": (0.972, 0.028, -0.5 * QUARTER)})
    env.step(STRAIGHT)
    assert env.physics.wall_bearings() == pytest.approx([-0.5 * QUARTER, 0.5 * QUARTER], abs=0.01)
    before = env.estimator.pose
    env.step(STRAIGHT)
    assert env.estimator.pose == pytest.approx(before, abs=1e-6)


@pytest.mark.parametrize("bearing", [0.1, 0.3, 0.5, 0.7, 0.9, 1.1, 1.3])
@pytest.mark.parametrize("side", [-1, 1])
def test_the_robot_slides_as_its_estimate_does(bearing, side):
    env = KheperaMazeEnv(bumps="contact", right_angles=False, motor_noise=0.0)
    env.reset(seed=0, options={"pose": (0.5, 0.0276, -QUARTER + side * (QUARTER - bearing))})
    env.step(STRAIGHT)
    env.estimator.fix(env.physics.pose())
    begin = env.physics.position()
    for _ in range(10):
        info = env.step(STRAIGHT)[4]
        assert info["collision"] and info["steps"] == 1
    x, y, _ = info["estimated_pose"] - info["true_pose"]
    slid = math.dist(begin, info["true_pose"][:2])
    assert slid > 0.001
    assert math.hypot(x, y) < 0.002 + 0.04 * slid  # standing still it would be wrong by all of it


def test_the_drag_of_the_tyres_is_fitted_to_the_simulated_robot():
    errors = []
    for bearing in np.arange(0.5, 1.4, 0.2):  # of the wall, seen from the heading
        physics = Physics()
        physics.place((0.5, 0.0276, -QUARTER + bearing))
        for step in range(15):
            if step == 5:
                begin = physics.position()
            physics.drive(FORWARD_SPEED, FORWARD_SPEED)
        along, aside = slide(10 * STEP_LENGTH, [-QUARTER - physics.pose()[2]])
        errors.append(math.hypot(along, aside) / math.dist(begin, physics.position()) - 1.0)
    assert np.abs(errors).max() < 0.09
    # Over all directions the estimate is 3 % short; a tenth more or less of DRAG is another 3 %.
    assert np.mean(errors) == pytest.approx(-0.028, abs=0.015)


def test_wheel_speeds_and_steering_move_a_robot_alike():
    # Of the paper: (10, 10), (-4, 4) and (4, -4) mm/s, over 10 mm/s.
    assert wheel_speeds(0.0) == [1.0, 1.0]
    assert wheel_speeds(1.0) == pytest.approx([-0.4, 0.4])  # to the left
    assert wheel_speeds(-1.0) == pytest.approx([0.4, -0.4])
    forward, turn = motion(np.array([RIGHT, STRAIGHT, LEFT]))
    assert (forward.tolist(), turn.tolist()) == ([0, 1, 0], [-1, 0, 1])
    steer = np.array([-1.0, -0.25, 0.0, 0.5, 1.0])
    forward, turn = motion(steer[:, None])
    assert turn.tolist() == steer.tolist()
    wheels = motion(np.array([wheel_speeds(value) for value in steer]))
    np.testing.assert_allclose(wheels, (forward, turn), atol=1e-15)
    forward, turn = motion(np.array([[0.2, 1.0], [1.0, 0.2], [-1.0, 1.0], [-0.5, -0.5]]))
    assert forward == pytest.approx([0.6, 0.6, 0.0, -0.5])
    assert turn == pytest.approx([1.0, -1.0, 1.0, 0.0])  # no faster than the fastest turn


def test_a_literal_estimate_always_moves():
    estimator = DeadReckoning("literal")
    estimator.fix((0.999, 0.5, 0.0))
    estimator.update(0.005, 0.005, [0.0])
    assert estimator.pose == pytest.approx((1.004, 0.5, 0.0))


def visit(env, place):
    """Carry the robot to a place without its knowledge, and let it turn there."""
    env.physics.place((*place, 0.0))
    return env.step(LEFT)[4]


@pytest.mark.parametrize(
    ("landmarks", "expected"),
    [
        ("pose", [0, 1, 0, 1, 0, 0]),  # on every entry
        ("position", [0, 1, 0, 1, 0, 0]),
        ("inside", [0, 1, 0, 1, 1, 1]),  # at every step, and the start is a landmark too
        ("first", [0, 1, 0, 0, 0, 0]),
    ],
)
def test_landmarks_correct_the_estimate(landmarks, expected):
    env = KheperaMazeEnv(landmarks=landmarks, motor_noise=0.0)
    env.reset(seed=0)
    corrected = []
    lost, (x, y) = (0.5, 0.5), env.plan.subgoals[0]
    for place in (lost, (x, y), lost, (x - 0.05, y), (x, y), env.plan.start[:2]):
        env.estimator.pose = (0.6, 0.6, 2.0)  # as if it was lost altogether
        info = visit(env, place)
        x_error, y_error, turned = info["true_pose"] - info["estimated_pose"]
        corrected.append(math.hypot(x_error, y_error) < 1e-9)
        assert (abs(turned) < 1e-3) == (corrected[-1] and landmarks != "position")
    assert corrected == list(map(bool, expected))


def test_a_restored_robot_knows_that_it_was_inside_a_landmark():
    env, other = (KheperaMazeEnv(motor_noise=0.0) for _ in range(2))
    env.reset(seed=0)
    visit(env, env.plan.subgoals[0])
    other.reset(seed=1)
    other.load_state_dict(env.state_dict())
    for robot in (env, other):
        robot.estimator.pose = (0.5, 0.5, 0.0)
        assert robot.step(LEFT)[4]["estimated_pose"][:2] == pytest.approx([0.5, 0.5])


def test_a_reset_corrects_the_estimate():
    env = KheperaMazeEnv(pose="estimated")
    env.reset(seed=0)
    observation, info = env.reset(options={"pose": (0.5, 0.2, 4.0)})
    np.testing.assert_allclose(observation, info["true_pose"], atol=1e-6)
    assert observation[2] == pytest.approx(4.0 - 2.0 * math.pi)


@pytest.mark.parametrize(("pose", "tolerance"), [("estimated", 0.2), ("odometry", 0.001)])
def test_miscalibrated_wheels_stretch_the_estimate(pose, tolerance):
    env = KheperaMazeEnv(pose=pose, wheel_radius_scale=1.1, wheel_base_scale=1.25, motor_noise=0.05)
    _, info = env.reset(seed=0, options={"pose": (0.4, 0.5, 0.0)})
    observation, *_, after = env.step(STRAIGHT)
    moved = after["true_pose"][0] - info["true_pose"][0]
    assert observation[0] - 0.4 == pytest.approx(1.1 * moved, rel=tolerance)
    observation, *_, info = env.step(RIGHT)
    assert observation[2] == pytest.approx(1.1 / 1.25 * info["true_pose"][2], rel=tolerance)


def test_encoders_see_the_motor_noise_that_commands_do_not():
    errors = {}
    for pose in ("estimated", "odometry"):
        env = KheperaMazeEnv(pose=pose)
        env.reset(seed=0, options={"pose": (0.4, 0.5, 0.0)})
        infos = [env.step(action)[4] for action in (1, 1, 0, 0, 2, 2, 1, 1)]
        errors[pose] = math.dist(infos[-1]["true_pose"][:2], infos[-1]["estimated_pose"][:2])
    assert errors["odometry"] < 0.0005 < errors["estimated"]


@pytest.fixture
def open_field(tmp_path):
    """An MJCF of the robot in a 10 m x 10 m arena without inner walls."""
    spec = mujoco.MjSpec.from_file(str(standard_path()))
    spec.delete(spec.geom("wall_lower"))
    spec.delete(spec.geom("wall_upper"))
    for name, x, y in (("south", 5, -5), ("north", 5, 15), ("west", -5, 5), ("east", 15, 5)):
        wall = spec.geom(f"wall_{name}")
        wall.pos[:2], wall.size[:2] = (x, y), (5, 5)
    path = tmp_path / "field.xml"
    path.write_text(spec.to_xml())
    return path


def drift(path, runs):
    """Return position [mm] and heading [rad] errors after 510 collision-free steps."""
    env = KheperaMazeEnv(layout=path)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(runs):
        env.reset(options={"pose": (5.0, 5.0, rng.uniform(-math.pi, math.pi))})
        actions = np.concatenate([np.ones(40, dtype=int), rng.choice([LEFT, RIGHT], 11)])
        infos = [env.step(action)[4] for action in rng.permutation(actions)]
        assert infos[-1]["total_steps"] == 510 and not any(info["collision"] for info in infos)
        x, y, heading = infos[-1]["estimated_pose"] - infos[-1]["true_pose"]
        errors.append((1000.0 * math.hypot(x, y), abs(wrap_angle(heading))))
    return np.array(errors).T


def test_drift_is_that_of_the_khepera_simulator(open_field):
    # Its own noise, over 2000 such runs: median 14 mm and 0.016 rad.
    position, heading = drift(open_field, 20)
    assert 9.0 < np.median(position) < 20.0
    assert 0.009 < np.median(heading) < 0.025


@pytest.mark.slow
def test_drift_over_200_runs(open_field):
    position, heading = drift(open_field, 200)
    print(f"median {np.median(position):.1f} mm, {np.median(heading):.4f} rad")
    print(f"95 %   {np.quantile(position, 0.95):.1f} mm, {np.quantile(heading, 0.95):.4f} rad")
    assert 12.0 < np.median(position) < 16.0
    assert 35.0 < np.quantile(position, 0.95) < 53.0
    assert 0.013 < np.median(heading) < 0.019


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: MotorNoise(-0.1), "motor_noise"),
        (lambda: MotorNoise(0.1, "both"), "wheel_noise"),
        (lambda: DeadReckoning("gps"), "dead_reckoning"),
        (lambda: DeadReckoning("slide", wheel_base=0.0), "wheel_base"),
    ],
)
def test_impossible_settings_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
