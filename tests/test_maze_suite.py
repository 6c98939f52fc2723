"""What holds for the environment with every kind of action and of pose, with ranges and without."""

import copy
import itertools
import math
import pickle
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordEpisodeStatistics, RecordVideo

from sofnn_torch.maze.env import KheperaMazeEnv

ID = "sofnn_torch:KheperaMaze-v0"
ACTIONS = ("three", "steer", "wheels")
POSES = ("estimated", "odometry", "true")
KINDS = [
    {"actions": actions, "pose": pose, "range_sensors": ranges}
    for actions, pose, ranges in itertools.product(ACTIONS, POSES, (False, True))
]
KINDS += [{"layout": name} for name in ("starts", "anywhere", "goals", "random:0")]
KINDS += [{"dead_reckoning": "literal", "wheel_noise": "independent"}, {"dead_reckoning": "still"}]

every_kind = pytest.mark.parametrize(
    "kind", KINDS, ids=lambda kind: "-".join(str(value) for value in kind.values())
)


def drive(env, decisions, seed=0):
    """All that random actions bring about, as one array; a trial that ends is followed by one."""
    env.action_space.seed(seed)
    rows = []
    for _ in range(decisions):
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        rows.append([*observation, reward, terminated, truncated, info["steps"]])
        rows[-1] += [*info["true_pose"], *info["estimated_pose"], *info["subgoals"]]
        if terminated or truncated:
            env.reset()
    return np.array(rows)


@every_kind
def test_gymnasium_accepts_the_environment(kind):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(ID, **kind).unwrapped, skip_render_check=True)
        env = gymnasium.make(ID, max_steps=100, **kind)  # with Gymnasium's passive checker
        env.reset(seed=0)
        drive(env, 20)
        env.close()


@every_kind
def test_the_observation_is_the_pose_that_was_asked_for(kind):
    env = KheperaMazeEnv(**kind)
    observation, info = env.reset(seed=0, options={"pose": (0.4, 0.5, 0.0)})  # far from landmarks
    known = "true_pose" if kind.get("pose") == "true" else "estimated_pose"
    env.action_space.seed(0)
    differed = False
    for _ in range(30):  # a landmark near it makes both equal for a while
        np.testing.assert_array_equal(observation[:3], np.float32(info[known]))
        observation, *_, info = env.step(env.action_space.sample())
        differed |= bool((info["true_pose"] != info["estimated_pose"]).any())
    assert differed


@every_kind
def test_a_seed_decides_the_trajectory(kind):
    env, other = (KheperaMazeEnv(max_steps=120, **kind) for _ in range(2))
    runs = []
    for maze, seed in ((env, 3), (env, 3), (other, 3), (other, 4)):
        maze.reset(seed=seed)
        runs.append(drive(maze, 14))  # through the end of a trial
    np.testing.assert_array_equal(runs[0], runs[1])
    np.testing.assert_array_equal(runs[0], runs[2])
    assert (runs[0] != runs[3]).any()


@pytest.mark.parametrize("kind", KINDS[1:18:8], ids=str)  # each action, each pose, with ranges
def test_observations_are_valid_not_aliased_and_change(kind):
    env = KheperaMazeEnv(**kind)
    observation, _ = env.reset(seed=0)
    env.action_space.seed(0)
    kept, copies = [observation], [observation.copy()]
    for _ in range(500):
        observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        assert np.isfinite(observation).all() and math.isfinite(reward)
        assert observation in env.observation_space
        assert not any(np.shares_memory(observation, other) for other in kept[-3:])
        kept.append(observation)
        copies.append(observation.copy())
        if terminated or truncated:
            env.reset()
    np.testing.assert_array_equal(kept, copies)
    assert (np.ptp(copies, axis=0) > 0.01).all()


@pytest.mark.parametrize("layout", ["s", "goals"])
@pytest.mark.parametrize("actions", ACTIONS)
def test_stable_baselines_accepts_the_environment(actions, layout):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(gymnasium.make(ID, actions=actions, layout=layout).unwrapped)


def piece(env):
    """What belongs to one simulation only."""
    physics = env.unwrapped.physics
    return [physics.data.qpos, physics.data.ctrl, physics._qpos, physics._ctrl]


@pytest.mark.parametrize(
    "when, kind",
    [("in a trial", kind) for kind in KINDS]
    + [(when, kind) for when in ("before a reset", "after a reset") for kind in KINDS[1::8]],
    ids=str,
)
def test_copies_and_pickles_drive_like_the_original_and_apart_from_it(kind, when):
    env = gymnasium.make(ID, max_steps=100, **kind)
    if when != "before a reset":
        env.reset(seed=5)
    if when == "in a trial":
        drive(env, 7, seed=1)
    twin = copy.deepcopy(env)
    others = [twin, copy.deepcopy(twin), pickle.loads(pickle.dumps(env))]
    others.append(pickle.loads(pickle.dumps(others[-1])))
    for one, two in itertools.combinations([env, *others], 2):
        for a, b in itertools.product(piece(one), piece(two)):
            assert not np.shares_memory(a, b)
    if when == "before a reset":
        starts = [maze.reset(seed=5)[0] for maze in (env, *others)]
        assert (np.array(starts) == starts[0]).all()
    expected = drive(env, 15)  # through the end of a trial at 100 steps
    for other in others:
        np.testing.assert_array_equal(drive(other, 15), expected)


def test_a_copy_neither_draws_nor_records_for_the_original():
    env = KheperaMazeEnv()
    env.reset(seed=0)
    env._renderer, recorded = object(), []  # as one that cannot be copied
    env.on_simulator_step = lambda: recorded.append(1)  # and cannot be pickled
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        other.step(1)
        assert other._renderer is None and not recorded
    env.step(1)
    assert recorded
    env._renderer = None


@pytest.mark.parametrize(("actions", "pose"), list(itertools.product(ACTIONS, POSES)))
def test_vector_environments_step_like_single_ones(actions, pose):
    kind = {"actions": actions, "pose": pose, "max_steps": 60}
    envs = gymnasium.make_vec(ID, num_envs=2, vectorization_mode="sync", **kind)
    seen = [envs.reset(seed=[3, 4])[0]]
    envs.action_space.seed(0)
    moves = [envs.action_space.sample() for _ in range(6)]
    for move in moves:
        observation, _, _, truncated, info = envs.step(move)
        seen.append(observation)
        assert {value.dtype.kind for value in info.values()} <= set("biuf")
        assert info["subgoals"].shape == (2, 2) and info["true_pose"].shape == (2, 3)
    for i, seed in enumerate((3, 4)):
        env = gymnasium.make(ID, **kind)
        alone = [env.reset(seed=seed)[0], *(env.step(move[i])[0] for move in moves)]
        np.testing.assert_array_equal([both[i] for both in seen], alone)
    assert truncated.any() == (info["total_steps"].max() >= 60)
    envs.close()


def test_asynchronous_environments_step_like_synchronous_ones():
    results = []
    for mode in ("sync", "async"):
        envs = gymnasium.make_vec(ID, num_envs=2, vectorization_mode=mode, max_steps=50)
        rows = [envs.reset(seed=1)[0]]
        rows += [envs.step(np.array([1, move]))[0] for move in (2, 1, 1, 0, 1, 2, 2)]
        results.append(rows)
        envs.close()
    np.testing.assert_array_equal(*results)


def test_statistics_of_episodes_are_those_of_the_trial():
    env = RecordEpisodeStatistics(gymnasium.make(ID, max_steps=45, step_reward=-1.0))
    env.reset(seed=0)
    truncated = False
    while not truncated:
        *_, truncated, info = env.step(2)
    assert info["episode"]["l"] == 5 and info["episode"]["r"] == -5.0
    assert info["is_success"] is info["success"] is False


def test_a_trial_is_recorded_as_a_video(tmp_path):
    pytest.importorskip("moviepy")
    env = gymnasium.make(ID, render_mode="rgb_array", max_steps=40, width=64, height=64)
    try:
        env.reset(seed=0)
        env.render()
    except ValueError:
        pytest.skip("this machine cannot draw")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of the library that writes it
        video = RecordVideo(env, str(tmp_path), episode_trigger=lambda _: True, disable_logger=True)
        video.reset(seed=0)
        while not video.step(1)[3]:
            pass
        video.close()
    (file,) = tmp_path.glob("*.mp4")
    assert file.stat().st_size > 500
