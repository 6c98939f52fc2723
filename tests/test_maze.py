"""The maze as a Gymnasium environment."""

import io
import itertools
import math
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from sofnn_torch.maze.env import LEFT, RIGHT, STRAIGHT, KheperaMazeEnv


@pytest.mark.parametrize(
    ("actions", "pose", "options"),
    [
        *itertools.product(("three", "steer", "wheels"), ("estimated", "odometry", "true"), ({},)),
        ("three", "estimated", {"range_sensors": True}),
        ("three", "estimated", {"dead_reckoning": "literal", "wheel_noise": "independent"}),
    ],
)
def test_gymnasium_accepts_the_environment(actions, pose, options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(
            "sofnn_torch:KheperaMaze-v0", actions=actions, pose=pose, **options
        ).unwrapped
        check_env(env, skip_render_check=True)


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


@pytest.mark.parametrize("pose", ["estimated", "odometry", "true"])
def test_observations_are_finite_not_aliased_and_change(pose):
    env = KheperaMazeEnv(pose=pose, range_sensors=True)
    observation, _ = env.reset(seed=0)
    env.action_space.seed(0)
    kept, copies = [observation], [observation.copy()]
    for _ in range(1000):
        observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        assert np.isfinite(observation).all() and math.isfinite(reward)
        assert observation in env.observation_space
        kept.append(observation)
        copies.append(observation.copy())
        if terminated or truncated:
            env.reset()
    np.testing.assert_array_equal(kept, copies)
    assert (np.ptp(copies, axis=0) > 0.01).all()


def test_20000_random_steps_stay_sound():
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
    while steps < 20_000:
        _, _, terminated, _, info = env.step(rng.choice(3, p=[0.15, 0.7, 0.15]))
        steps += info["steps"]
        bumps += info["collision"]
        if terminated:
            env.reset()
            last = physics.position()
    assert bumps > 500
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


def test_a_trial_that_reaches_the_goal_in_its_last_step_is_not_cut_off():
    env = KheperaMazeEnv(motor_noise=0.0, max_steps=3)
    x, y = env.plan.goal
    env.reset(options={"pose": (x - 0.073, y, 0.0)})
    _, _, terminated, truncated, info = env.step(STRAIGHT)
    assert info["total_steps"] == 3 and terminated and not truncated


@pytest.fixture
def bumping(monkeypatch):
    """A maze whose robot feels a wall before it in every step, also where none is."""
    env = KheperaMazeEnv(motor_noise=0.0, collision_reward=-0.5)
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
    assert info["subgoals"] == (True, False) and reward == 0.5 - 0.5
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
    env = KheperaMazeEnv(motor_noise=0.0)
    x, y = env.plan.subgoals[0]
    away = (x - 0.1, y - 0.1, 0.25 * math.pi)
    for _ in range(2):
        env.reset(options={"pose": away})
        _, reward, _, _, info = env.step(STRAIGHT)
        assert info["subgoals"] == (False, False) and reward == 0.0
        _, reward, _, _, info = env.step(STRAIGHT)
        assert info["subgoals"] == (True, False) and reward == 0.5
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
    env, other = KheperaMazeEnv(), KheperaMazeEnv()
    env.reset(seed=0)
    env.physics.place((*env.plan.subgoals[1], 0.0))
    assert env.step(LEFT)[1] == 0.5
    other.load_state_dict(env.state_dict())
    _, reward, _, _, info = other.step(LEFT)
    assert info["subgoals"] == (False, True) and reward == 0.0


def test_a_restored_trial_that_was_over_is_over():
    env, other = KheperaMazeEnv(max_steps=10), KheperaMazeEnv()
    env.reset(seed=0)
    assert env.step(LEFT)[3]
    other.reset()
    other.load_state_dict(env.state_dict())
    with pytest.raises(gymnasium.error.ResetNeeded):
        other.step(LEFT)


@pytest.mark.parametrize(
    "options",
    [
        {"pose": "gps"},
        {"actions": "four"},
        {"hold": 0},
        {"hold": 2.5},
        {"max_steps": 0},
        {"motor_noise": 1.0},
        {"motor_noise": math.nan},
        {"wheel_noise": "pink"},
        {"dead_reckoning": "perfect"},
        {"goal_reward": math.nan},
        {"wheel_radius_scale": 0.0},
        {"wheel_base_scale": math.inf},
        {"render_mode": "ansi"},
        {"model_path": "no/such/file.xml"},
    ],
)
def test_impossible_settings_are_refused(options):
    with pytest.raises(ValueError, match=str(next(iter(options.values())))):
        KheperaMazeEnv(**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"goal": 1}, "unknown"),
        ({"pose": (0.5, 0.333, 0.0)}, "wall"),
        ({"pose": (1.5, 0.5, 0.0)}, "wall"),
        ({"pose": (0.5, math.nan, 0.0)}, "finite"),
        ({"pose": (0.5, 0.5)}, "three"),
    ],
)
def test_impossible_starts_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        KheperaMazeEnv().reset(options=options)


@pytest.mark.parametrize(
    ("actions", "action"),
    [("three", 3), ("three", 0.5), ("steer", [1.5]), ("steer", [0, 0]), ("wheels", [math.nan, 0])],
)
def test_impossible_actions_are_refused(actions, action):
    env = KheperaMazeEnv(actions=actions)
    env.reset()
    with pytest.raises(ValueError, match="action must be"):
        env.step(action)
