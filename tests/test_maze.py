"""The maze as a Gymnasium environment."""

import io
import itertools
import math

import gymnasium
import mujoco
import numpy as np
import pytest
import torch

from sofnn_torch.maze.env import LEFT, RIGHT, STRAIGHT, KheperaMazeEnv
from sofnn_torch.maze.layouts import standard_path
from sofnn_torch.maze.odometry import FORWARD_SPEED, pose_errors
from sofnn_torch.runs.factory import make_env
from sofnn_torch.runs.settings import Config


def rollout(env, seed, decisions=60):
    """Return observations, rewards and true poses of random actions."""
    env.reset(seed=seed)
    actions = np.random.default_rng(7).integers(3, size=decisions)
    steps = [env.step(action) for action in actions]
    return [np.array([step[0], np.float32(step[4]["true_pose"])]) for step in steps]


def test_a_seed_decides_the_trajectory():
    env = KheperaMazeEnv()
    first, again, other = rollout(env, 3), rollout(env, 3), rollout(KheperaMazeEnv(), 4)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first, rollout(KheperaMazeEnv(), 3))
    assert not np.array_equal(first, other)


def test_observing_ranges_does_not_disturb_the_robot():
    plain = rollout(KheperaMazeEnv(), 5)
    env = KheperaMazeEnv(range_sensors=True)
    env.reset(seed=5)
    actions = np.random.default_rng(7).integers(3, size=60)
    seen = np.array([env.step(action)[0][:3] for action in actions])
    np.testing.assert_array_equal(seen, [step[0] for step in plain])


@pytest.mark.parametrize("count", [6000, pytest.param(20_000, marks=pytest.mark.slow)])
def test_random_steps_stay_sound(count):
    env = KheperaMazeEnv(hold=10, max_steps=10**9)
    env.reset(seed=1)
    physics, supports = env.physics, env.physics.data.ncon
    hidden = 0
    rng = np.random.default_rng(1)
    last, steps, bumps = physics.position(), 0, 0

    def check():
        nonlocal last, hidden
        x, y = physics.position()
        assert np.isfinite(physics.data.qpos).all() and np.isfinite(physics.data.qvel).all()
        assert physics.plan.clearance(x, y) > -0.0005
        assert math.dist((x, y), last) < 0.0060  # no kicks, no tunnelling
        assert physics.data.body("khepera").xmat[8] > 0.998  # upright
        assert physics.bumped() == bool(physics.wall_bearings())
        hidden += physics.bumped() and physics.data.ncon <= supports
        last = (x, y)

    env.on_simulator_step = check
    while steps < count:
        _, _, terminated, _, info = env.step(rng.choice(3, p=[0.15, 0.7, 0.15]))
        steps += info["steps"]
        bumps += info["collision"]
        if terminated:
            env.reset()
            last = physics.position()
    assert bumps > count / 40
    assert hidden > 0  # bumps with no more contacts than at rest, as a wheel was off the floor


def test_the_goal_ends_the_trial_and_pays_once_reached():
    env = KheperaMazeEnv(motor_noise=0.0, step_reward=-0.25)
    x, y = env.plan.goal
    for distance in (0.073, 0.093, 0.12):
        env.reset(options={"pose": (x - distance, y, 0.0)})
        _, reward, terminated, truncated, info = env.step(STRAIGHT)
        reached = math.dist(info["true_pose"][:2], (x, y)) <= env.plan.goal_radius
        assert terminated == info["success"] == reached == (distance < 0.11)
        assert reward == pytest.approx(-0.25 + 1.0 * reached)
        assert not truncated
        assert info["steps"] == (math.ceil((distance - 0.06) / 0.005) if reached else 10)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("axis", [0, 1])
def test_zones_end_where_the_maze_is_drawn(axis, side):
    env = KheperaMazeEnv(motor_noise=0.0, landmarks="inside")  # zones of 80 mm, the goal 60 mm
    zones = [(env.plan.start[:2], 0.08), (env.plan.goal, 0.06)]
    zones += [(place, 0.08) for place in env.plan.subgoals]
    assert len(zones) == 4
    for (centre, radius), beyond in itertools.product(zones, (-0.001, 0.001)):
        env.reset(seed=0)
        place = np.array(centre)
        place[axis] += side * (radius + beyond)
        env.estimator.fix((0.5, 0.5, 0.0))
        env.physics.place((*place, 0.0))
        if env.plan.clearance(*place) < 0.002:
            continue
        info = env.step(LEFT)[4]  # which turns on the spot
        inside = beyond < 0
        if centre == env.plan.goal:
            assert info["success"] == inside
        else:
            error = math.dist(info["true_pose"][:2], info["estimated_pose"][:2])
            assert (error < 1e-3) == inside
            assert info["subgoals"].sum() == (inside and centre != env.plan.start[:2])


def test_a_trial_that_reaches_the_goal_in_its_last_step_is_not_cut_off():
    env = KheperaMazeEnv(motor_noise=0.0, max_steps=3)
    x, y = env.plan.goal
    env.reset(options={"pose": (x - 0.073, y, 0.0)})
    _, _, terminated, truncated, info = env.step(STRAIGHT)
    assert info["total_steps"] == 3 and terminated and not truncated


@pytest.fixture
def bumping(monkeypatch):
    """A maze whose robot feels a wall before it in every step, also where none is."""
    rewards = {"collision_reward": -0.5, "subgoal_reward": 0.25}
    env = KheperaMazeEnv(bumps="contact", motor_noise=0.0, **rewards)
    env.reset(seed=0)
    monkeypatch.setattr(env.physics, "bumped", lambda: True)
    monkeypatch.setattr(env.physics, "wall_bearings", lambda: [0.0])
    return env


def test_the_goal_counts_also_with_a_bump(bumping):
    bumping.physics.place((*bumping.plan.goal, 0.0))
    _, reward, terminated, _, info = bumping.step(LEFT)
    assert terminated and info["collision"] and info["success"]
    assert reward == 1.0 - 0.5


def test_landmarks_count_also_with_a_bump(bumping):
    bumping.physics.place((*bumping.plan.subgoals[0], 0.0))
    _, reward, _, _, info = bumping.step(LEFT)
    assert info["subgoals"].tolist() == [1, 0] and reward == 0.25 - 0.5
    np.testing.assert_array_equal(info["estimated_pose"], info["true_pose"])


def test_a_bump_ends_the_decision():
    env = KheperaMazeEnv(motor_noise=0.0, collision_reward=-0.5)
    env.reset(options={"pose": (0.955, 0.15, 0.0)})
    _, reward, terminated, _, info = env.step(STRAIGHT)
    assert info["collision"] and info["steps"] == 4 and reward == -0.5 and not terminated
    _, reward, _, _, info = env.step(STRAIGHT)
    assert info["collision"] and info["steps"] == 1 and reward == -0.5
    _, reward, _, _, info = env.step(LEFT)
    _, reward, _, _, info = env.step(LEFT)
    assert not info["collision"] and info["steps"] == 10 and reward == 0.0


def test_a_subgoal_pays_once_a_trial():
    env = KheperaMazeEnv(motor_noise=0.0, subgoal_reward=0.5)
    x, y = env.plan.subgoals[0]
    away = (x - 0.1, y - 0.1, 0.25 * math.pi)
    for _ in range(2):
        env.reset(options={"pose": away})
        _, reward, _, _, info = env.step(STRAIGHT)
        assert not info["subgoals"].any() and reward == 0.0
        _, reward, _, _, info = env.step(STRAIGHT)
        assert info["subgoals"].tolist() == [1, 0] and reward == 0.5
        env.physics.place(away)
        rewards = [env.step(STRAIGHT)[1] for _ in range(3)]
        assert rewards == [0.0, 0.0, 0.0]


def test_a_trial_is_truncated_at_its_limit():
    env = KheperaMazeEnv(max_steps=25)
    env.reset(seed=0)
    results = [env.step(LEFT) for _ in range(3)]
    assert [result[4]["steps"] for result in results] == [10, 10, 5]
    assert [result[3] for result in results] == [False, False, True]
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        env.step(LEFT)


def test_the_trail_begins_where_the_robot_is_put():
    env = KheperaMazeEnv()
    env.reset(options={"pose": (0.4, 0.5, 1.0)})
    assert env.trail == [(0.4, 0.5)]
    env.reset()
    assert env.trail == [env.plan.start[:2]]


def test_a_literal_estimate_may_leave_the_arena_by_what_a_trial_can_drive():
    space = KheperaMazeEnv(dead_reckoning="literal", max_steps=100).observation_space
    assert space.low[:2] == pytest.approx([-0.5, -0.5])  # 100 steps of 5 mm
    assert space.high[:2] == pytest.approx([1.5, 1.5])
    believed = KheperaMazeEnv(dead_reckoning="literal", max_steps=100, wheel_radius_scale=2.0)
    assert believed.observation_space.low[:2] == pytest.approx([-1.0, -1.0])


def test_steering_contains_the_three_actions():
    three, steer = KheperaMazeEnv(), KheperaMazeEnv(actions="steer")
    for action in (RIGHT, STRAIGHT, LEFT):
        assert three.wheel_speeds(action) == steer.wheel_speeds(np.array([action - 1.0]))
    assert three.wheel_speeds(LEFT) == (-0.004, 0.004) and three.wheel_speeds(STRAIGHT) == (
        0.010,
        0.010,
    )
    assert steer.wheel_speeds([0.5]) == pytest.approx((0.003, 0.007))
    wheels = KheperaMazeEnv(actions="wheels")
    assert wheels.wheel_speeds(np.array([-0.4, 1.0])) == pytest.approx((-0.004, 0.010))


@pytest.mark.parametrize("pose", ["estimated", "odometry"])
def test_a_restored_state_has_the_same_future(pose):
    env = KheperaMazeEnv(pose=pose, range_sensors=True, actions="steer")
    env.reset(seed=11)
    env.action_space.seed(11)
    for _ in range(70):
        env.step(env.action_space.sample())
    file = io.BytesIO()
    torch.save(env.state_dict(), file)
    actions = [env.action_space.sample() for _ in range(100)]
    future = [env.step(action) for action in actions]

    file.seek(0)
    other = KheperaMazeEnv(pose=pose, range_sensors=True, actions="steer")
    other.load_state_dict(torch.load(file, weights_only=True))
    for expected, action in zip(future, actions, strict=True):
        observation, reward, terminated, truncated, info = other.step(action)
        np.testing.assert_array_equal(observation, expected[0])
        assert (reward, terminated, truncated) == expected[1:4]
        assert info["total_steps"] == expected[4]["total_steps"]
        np.testing.assert_array_equal(info["true_pose"], expected[4]["true_pose"])
    np.testing.assert_array_equal(env.reset()[0], other.reset()[0])


def test_a_restored_trial_knows_the_subgoals_it_has_found():
    env, other = (KheperaMazeEnv(subgoal_reward=0.5) for _ in range(2))
    env.reset(seed=0)
    env.physics.place((*env.plan.subgoals[1], 0.0))
    assert env.step(LEFT)[1] == 0.5
    other.load_state_dict(env.state_dict())
    _, reward, _, _, info = other.step(LEFT)
    assert info["subgoals"].tolist() == [0, 1] and reward == 0.0


def test_a_restored_trial_that_was_over_is_over():
    env, other = KheperaMazeEnv(max_steps=10), KheperaMazeEnv()
    env.reset(seed=0)
    assert env.step(LEFT)[3]
    other.reset()
    other.load_state_dict(env.state_dict())
    with pytest.raises(gymnasium.error.ResetNeeded):
        other.step(LEFT)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("pose", ["gps", None, 1, ["true"], np.array(["true", "estimated"])]),
        ("actions", ["four", None, 3]),
        ("hold", [0, 2.5, -1, math.inf, math.nan, None, "10", True, 10_001, np.array([10, 10])]),
        ("max_steps", [0, 2.5, math.inf, -math.inf, math.nan, None, "10", True, 2**63, 10**400]),
        ("motor_noise", [1.0, -0.1, math.nan, math.inf, None, "0.1", True, np.array([0.1, 0.2])]),
        ("wheel_noise", ["pink", None, 1]),
        ("dead_reckoning", ["perfect", "guarded", None, 1]),
        ("bumps", ["whisker", None, 1]),
        ("infrared_noise", [1.0, -0.1, math.nan, None, "0.1", True]),
        ("landmarks", ["all", None, 1]),
        ("right_angles", [None, 1, "yes"]),
        *((f"{part}_reward", [math.nan, math.inf, None, "1", True, 1j, 10**400])
          for part in ("goal", "collision", "subgoal", "step")),
        *((f"wheel_{part}_scale", [0.0, -1, math.inf, math.nan, None, "1", True])
          for part in ("radius", "base")),
        ("range_sensors", [None, 1, "yes", np.array([True, False])]),
        ("render_mode", ["ansi", 1, np.array(["human"])]),
        ("layout", ["no/such/file.xml", 5, b"maze.xml", [], None, __file__, "rooms\0", "random:x"]),
        ("camera", ["side", None, 0]),
        ("speed", [0.0, -1, math.inf, None, "20"]),
        ("width", [0, -1, 2.5, 9000, None, "480", math.nan]),
        ("height", [0, -1, 2.5, 9000, None, "480", math.nan]),
    ],
)  # fmt: skip
def test_impossible_settings_are_refused_in_one_line_that_names_them(name, values):
    for value in values:
        with pytest.raises(ValueError, match=name.replace("_", "[-_]")) as error:
            KheperaMazeEnv(**{name: value})
        assert "\n" not in str(error.value) and len(str(error.value)) < 200, value


def test_scalars_of_numpy_are_taken_as_numbers():
    env = KheperaMazeEnv(
        actions=np.str_("steer"),
        hold=np.int64(5),
        max_steps=np.uint16(50),
        motor_noise=np.float32(0.0),
        goal_reward=np.int8(3),
        wheel_base_scale=np.float32(1.0),
        range_sensors=np.True_,
        width=np.int32(64),
    )
    env.reset(seed=0)
    observation, reward, _, _, info = env.step([0.0])
    assert observation.shape == (12,) and info["steps"] == 5 and reward == 0.0
    chosen = env.settings
    numbers = (chosen.hold, chosen.max_steps, env.noise.magnitude, chosen.goal_reward, env.width)
    assert [type(number) for number in numbers] == [int, int, float, float, int]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda spec: spec.delete(spec.site("goal")), "goal"),
        (lambda spec: spec.delete(spec.sensor("ir_left_0")), "ir_left_0"),
        (lambda spec: spec.delete(spec.key("start")), "start"),
        (lambda spec: [spec.delete(geom) for geom in spec.geoms if "wall" in geom.name], "wall"),
    ],
)
def test_a_model_that_lacks_an_element_is_refused(change, message, tmp_path):
    spec = mujoco.MjSpec.from_file(str(standard_path()))
    change(spec)
    path = tmp_path / "maze.xml"
    path.write_text(spec.to_xml())
    with pytest.raises(ValueError, match=f"lacks an element.*{message}") as error:
        KheperaMazeEnv(layout=path)
    assert "\n" not in str(error.value) and len(str(error.value)) < 200


def test_a_maze_without_subgoals_is_a_maze(tmp_path):
    spec = mujoco.MjSpec.from_file(str(standard_path()))
    for name in ("subgoal_1", "subgoal_2"):
        spec.delete(spec.site(name))
    path = tmp_path / "maze.xml"
    path.write_text(spec.to_xml())
    env = KheperaMazeEnv(layout=path)
    env.reset(seed=0)
    assert env.step(STRAIGHT)[4]["subgoals"].shape == (0,)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"goal": 1}, "unknown"),
        ({"pose": (0.5, 0.333, 0.0)}, "wall"),
        ({"pose": (1.5, 0.5, 0.0)}, "wall"),
        ({"pose": (0.5, math.nan, 0.0)}, "finite"),
        ({"pose": (0.5, 0.5)}, "three"),
        ({"pose": None}, "three"),
        ({"pose": ("0.5", "0.5", "0")}, "three"),
        ({"pose": 0.5}, "three"),
    ],
)
def test_impossible_starts_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        KheperaMazeEnv().reset(options=options)


ODD = [None, "1", b"1", math.nan, math.inf, True, [True], 1j, {}, [[0], [1, 2]], object()]
ODD += [[], [0, 1, 2], np.array([0, 1, 2]), torch.ones(1, requires_grad=True) * math.nan]


@pytest.mark.parametrize(
    ("actions", "odd"),
    [
        ("three", [3, -1, 0.5, 1.5, [0, 1], np.zeros(2), np.int64(3), 2**70]),
        ("steer", [1.5, [-1.001], [0, 0], np.array([2.0]), 10**400]),
        ("wheels", [0.5, [0.5], [math.nan, 0], [0, 1.5], ["0", "0"]]),
    ],
)
def test_impossible_actions_are_refused_in_one_line_and_leave_the_trial_alone(actions, odd):
    env = KheperaMazeEnv(actions=actions)
    env.reset(seed=0)
    before = env.state_dict()
    for action in odd + ODD:
        with pytest.raises(ValueError, match="action must be") as error:
            env.step(action)
        assert "\n" not in str(error.value) and len(str(error.value)) < 150, action
    assert env.state_dict() == before


@pytest.mark.parametrize(
    ("actions", "ways"),
    [
        ("three", [1, 1.0, np.int64(1), np.uint8(1), [1], np.array(1), np.array([1]),
                   np.array([[1]]), torch.tensor(1), torch.tensor([1])]),
        ("steer", [0, 0.0, [0], np.zeros(1), np.zeros((1, 1), np.float32), torch.zeros(1)]),
        ("wheels", [[1, 1], (1.0, 1.0), np.ones(2), np.ones((1, 2)), torch.ones(2)]),
    ],
)  # fmt: skip
def test_an_action_can_be_written_in_many_ways(actions, ways):
    env = KheperaMazeEnv(actions=actions)
    assert {env.wheel_speeds(way) for way in ways} == {(FORWARD_SPEED, FORWARD_SPEED)}


def test_inputs_and_actions_have_names_and_ranges():
    env = KheperaMazeEnv()
    x, y, heading = env.axes
    assert (x.name, x.unit, x.low, x.high, x.period) == ("x", "m", 0.0, 1.0, 0.0)
    assert (y.name, y.unit, y.low, y.high, y.period) == ("y", "m", 0.0, 1.0, 0.0)
    assert (heading.name, heading.unit) == ("heading", "rad")
    assert (heading.low, heading.high, heading.period) == (-math.pi, math.pi, 2 * math.pi)
    assert env.action_names[LEFT] == "left turn" and env.action_names[RIGHT] == "right turn"
    assert env.action_names[STRAIGHT] == "straight"
    assert KheperaMazeEnv(actions="steer").action_names == ("steer",)
    assert KheperaMazeEnv(actions="wheels").action_names == ("left wheel", "right wheel")


def test_the_ranges_are_those_of_the_plan(tmp_path):
    spec = mujoco.MjSpec.from_file(str(standard_path()))
    spec.geom("wall_north").pos[1] += 0.5
    for side in ("west", "east"):
        spec.geom(f"wall_{side}").size[1] += 0.5
    path = tmp_path / "maze.xml"
    path.write_text(spec.to_xml())
    x, y, _ = KheperaMazeEnv(layout=path).axes
    assert (x.high, y.high) == (1.0, 1.5)


def test_errors_are_measured_over_decisions_and_headings_the_short_way_round():
    true = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 3.1], [2.0, 1.0, 0.5]])
    estimated = np.array([[0.0, 0.0, 0.0], [1.0, 1.5, -3.1], [2.3, 1.4, 0.25]])
    errors = pose_errors(true, estimated)
    turn = 2 * math.pi - 6.2
    assert errors == pytest.approx(
        {"pose_error": 0.5, "pose_error_max": 0.5, "heading_error": (turn + 0.25) / 2}
    )
    worse = np.array([*estimated[:2], [2.0, 1.1, 0.5]])
    assert pose_errors(true, worse)["pose_error_max"] == 0.5
    assert pose_errors(true, worse)["pose_error"] == pytest.approx(0.3)


def test_the_default_maze_is_the_one_that_training_uses():
    made = gymnasium.make("sofnn_torch:KheperaMaze-v0").unwrapped
    trained = make_env(Config()).unwrapped
    for name in ("settings", "pose_mode", "range_sensors", "plan"):
        assert getattr(made, name) == getattr(trained, name), name
    assert vars(made.noise) == vars(trained.noise)
    assert vars(made.estimator) == vars(trained.estimator)


def test_a_trial_is_measured_by_its_bumps_and_all_the_subgoals_that_it_found():
    env = KheperaMazeEnv()
    pose = np.zeros(3)
    bumps, found = [True, True, False, True], [(False, False)] * 2 + [(True, False), (True, True)]
    infos = [
        {"collision": bump, "subgoals": zones, "true_pose": pose, "estimated_pose": pose}
        for bump, zones in zip(bumps, found, strict=True)
    ]
    measured = env.measure(infos)
    env.close()
    assert (measured["collisions"], measured["subgoals"]) == (2, 2)  # none before the first action
