"""The simulated robot and its model."""

import math

import mujoco
import numpy as np
import pytest

from sofnn_torch.maze.robot import Physics, load_model
from sofnn_torch.maze.sensors import INFRARED, INFRARED_RANGE

FORWARD = (0.010, 0.010)
TURN_LEFT = (-0.004, 0.004)


@pytest.fixture
def physics():
    return Physics()


def tilt(physics):
    """Return the angle between the robot's axis and the vertical."""
    return math.acos(min(1.0, physics.data.body("khepera").xmat[8]))


def drive(physics, speeds, steps):
    """Return the poses (steps + 1, 3) along a drive."""
    poses = [physics.pose()]
    for _ in range(steps):
        physics.drive(*speeds)
        poses.append(physics.pose())
    return np.array(poses)


@pytest.mark.parametrize("heading", [0.0, 0.7, -2.3])
def test_a_straight_step_is_5_mm(physics, heading):
    physics.place((0.5, 0.5, heading))
    poses = drive(physics, FORWARD, 20)
    lengths = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    # The first step starts from rest; the wheels need a few milliseconds to get going.
    assert lengths[1:] == pytest.approx(0.005, rel=0.005)
    assert lengths[0] == pytest.approx(0.005, abs=2e-4)
    assert np.ptp(poses[:, 2]) < 1e-3


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_turning_step_is_80_mrad_and_a_full_turn_stays_in_place(physics, sign):
    physics.place((0.5, 0.5, 0.0))
    poses = drive(physics, (-sign * 0.004, sign * 0.004), 79)
    turns = np.diff(np.unwrap(poses[:, 2]))
    assert turns[1:] == pytest.approx(sign * 0.08, rel=0.005)
    assert np.linalg.norm(poses[:, :2] - poses[0, :2], axis=1).max() < 0.001


@pytest.mark.parametrize("speeds", [FORWARD, (0.011, 0.011), (0.010, 0.009)])
@pytest.mark.parametrize(
    "pose",
    [(0.92, 0.15, 0.0), (0.9, 0.15, 0.6), (0.5, 0.25, 1.2), (0.93, 0.07, -0.78), (0.75, 0.333, 3.1)]
    + [(0.1 + 0.0007 * i, 0.06, -1.4) for i in range(3)],
)
def test_walls_hold_and_turning_frees_the_robot(physics, pose, speeds):
    physics.place(pose)
    bumps = 0
    for _ in range(100):
        physics.drive(*speeds)
        bumps += physics.bumped()
        assert physics.plan.clearance(*physics.position()) > -0.0005
        assert tilt(physics) < 0.05
    assert bumps > 20
    stuck_at = physics.position()
    drive(physics, TURN_LEFT, round(math.pi / 0.08))
    drive(physics, FORWARD, 20)
    assert math.dist(physics.position(), stuck_at) > 0.05


def test_turning_beside_a_wall_is_no_bump(physics):
    physics.place((0.95, 0.15, 0.0))
    drive(physics, FORWARD, 20)
    assert physics.bumped()
    physics.drive(*TURN_LEFT)
    for _ in range(10):
        physics.drive(*TURN_LEFT)
        assert not physics.bumped()


def test_geoms_that_are_only_drawn_do_not_change_the_physics():
    lean, full = Physics(), Physics(load_model())
    assert lean.model.ngeom < full.model.ngeom
    for speeds in (FORWARD, TURN_LEFT, (0.01, 0.004)):
        np.testing.assert_array_equal(drive(lean, speeds, 5), drive(full, speeds, 5))


def test_infrared_ranges_see_walls():
    physics = Physics()
    physics.place((0.93, 0.15, 0.0))
    ranges = dict(zip(INFRARED, physics.infrared_ranges(), strict=True))
    ahead = 1.0 - 0.93 - 0.0245
    assert ranges["ir_left_0"] == pytest.approx(ahead, abs=1e-3)
    assert ranges["ir_right_0"] == pytest.approx(ahead, abs=1e-3)
    physics.place((0.96, 0.15, 0.0))
    ranges = dict(zip(INFRARED, physics.infrared_ranges(), strict=True))
    assert ranges["ir_right_45"] == pytest.approx((0.04 - 0.018) * math.sqrt(2.0), abs=1e-3)
    assert ranges["ir_back_left"] == ranges["ir_right_90"] == INFRARED_RANGE


def test_ranges_are_only_computed_when_they_are_asked_for():
    physics = Physics()
    physics.infrared_ranges()
    assert physics.data.sensordata.any()
    physics.place((0.93, 0.15, 0.0))
    physics.drive(*FORWARD)
    assert not physics.data.sensordata.any()  # as the reset has left it


def test_every_element_is_named():
    model = load_model()
    counts = {"joint": "njnt", "camera": "ncam", "actuator": "nu", "mat": "nmat", "tex": "ntex"}
    for kind in ("body", "geom", "site", "light", "sensor", "mesh", "key", *counts):
        number = getattr(model, counts.get(kind, f"n{kind}"))
        names = [getattr(model, kind)(i).name for i in range(number)]
        assert number and all(names), kind


def test_the_model_has_two_cameras_and_opens_as_the_maze():
    model = load_model()
    assert {model.camera(i).name for i in range(model.ncam)} == {"top", "chase"}
    data = mujoco.MjData(model)
    start = model.key("start").qpos.copy()
    np.testing.assert_allclose(data.qpos, start)
    mujoco.mj_step(model, data, 100)
    np.testing.assert_allclose(data.qpos, start, atol=5e-5)


def test_the_top_camera_is_fitted_to_the_maze():
    model = load_model()
    camera = model.camera("top")
    walls = [model.geom(i) for i in range(model.ngeom) if model.geom(i).name.startswith("wall")]
    corners = [np.abs(wall.pos - camera.pos)[:2] + wall.size[:2] for wall in walls]
    half_width = np.max(corners) / (camera.pos[2] - 2 * walls[0].size[2])
    assert 0.95 < half_width / math.tan(0.5 * math.radians(camera.fovy[0])) < 1.0


def test_the_plan_is_the_documented_maze(physics):
    plan = physics.plan
    assert plan.size == (1.0, 1.0) and len(plan.walls) == 6
    assert plan.robot_radius == 0.0275
    assert plan.walls[4] == pytest.approx((0.0, 0.308, 0.68, 0.358))
    for x, y in (plan.start[:2], plan.goal, *plan.subgoals):
        assert plan.clearance(x, y) > 0.05
    assert plan.clearance(0.5, 0.333) == pytest.approx(-plan.robot_radius)


def test_timesteps_must_divide_the_step():
    model = load_model(drawn=False)
    model.opt.timestep = 0.03
    with pytest.raises(ValueError, match="does not divide"):
        Physics(model)
