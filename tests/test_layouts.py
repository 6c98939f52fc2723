"""Mazes of one's own: maps, MJCF files, what is built in, and what is refused."""

import itertools
import math
import re
import shutil
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from sofnn_torch import evaluate
from sofnn_torch.maze import layouts, settings
from sofnn_torch.maze.env import KheperaMazeEnv
from sofnn_torch.maze.layouts import built_in, mjcf, random_map, standard_path
from sofnn_torch.maze.optimum import mean_optimum, optimal_steps
from sofnn_torch.maze.robot import Physics, load_model, plan_of
from sofnn_torch.runs import checkpoint, places, session
from sofnn_torch.runs.factory import make_plan
from sofnn_torch.runs.settings import Config, from_dict
from sofnn_torch.training import resume, train

CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER
NAMES = [*built_in(), "random:0"]
MAP = """; a comment

cell 0.1
.....G
.##...
.##.1.
>.....
"""
EMPTY = "\n".join(["cell 0.1", ".....", ".>.G.", "....."])


def test_a_map_is_the_maze_that_was_drawn():
    plan = plan_of(MAP)
    assert plan.size == (0.6, 0.4)
    assert plan.start == pytest.approx((0.05, 0.05, 0.0))
    assert plan.goals == [(0.55, 0.35)] and plan.subgoals == [(0.45, 0.15)]
    assert plan.walls[:2] == [
        pytest.approx((-0.02, -0.02, 0.62, 0.0)),
        pytest.approx((-0.02, 0.4, 0.62, 0.42)),
    ]
    assert plan.walls[4:] == [pytest.approx((0.1, 0.1, 0.3, 0.3))]
    assert (plan.goal_radius, plan.subgoal_radius, plan.start_radius) == (0.06, 0.08, 0.08)


@pytest.mark.parametrize(("mark", "degrees"), [(">", 0), ("^", 90), ("<", -180), ("v", -90)])
def test_a_start_shows_where_the_robot_looks(mark, degrees):
    heading = plan_of(EMPTY.replace(">", mark)).start[2]
    assert math.degrees(heading) == pytest.approx(degrees)


def test_boxes_cover_the_walls_of_a_map_and_nothing_else():
    rng = np.random.default_rng(0)
    for share in (0.1, 0.5, 0.9):
        wall = rng.random((9, 14)) < share
        covered = np.zeros_like(wall)
        boxes = layouts._boxes(wall)
        for x0, y0, x1, y1 in boxes:
            covered[y0:y1, x0:x1] = True
        np.testing.assert_array_equal(covered, wall)
        assert len(boxes) <= wall.sum()
    assert layouts._boxes(np.ones((3, 4), bool)) == [(0, 0, 4, 3)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (MAP.replace("G", "."), "no goal: mark it with G"),
        (MAP.replace(">", "."), r"no start: mark it with one of > \^ < v"),
        (MAP.replace(".....G", "G....G"), r"2 goals, at line 4, column 1 and line 4, column 6"),
        (MAP.replace(">.....", ">....<"), r"2 starts, at .*: leave one, or say 'start vary'"),
        (MAP.replace(".##...", ".##."), "line 5 has 4 cells and line 4 has 6"),
        (MAP.replace(".##.1.", ".##.x."), "line 6, column 5: 'x' is no cell"),
        (MAP.replace(".##.1.", ".##.2."), "sub-goals must be numbered 1, 2"),
        (MAP.replace(".##.1.", ".##11."), "sub-goals must be numbered 1, 2"),
        (MAP.replace("cell 0.1", "cel 0.1"), "line 3: 'cel 0.1' is not one of cell METRES"),
        (MAP.replace("cell 0.1", "cell 0"), "line 3: a cell must be 0.01 to 1 m long"),
        (MAP.replace("cell 0.1", "goal all"), "line 3: 'goal all' is not one of"),
        (MAP.replace("cell 0.1", "cell 1") + ".....\n" * 0, None),
        ("cell 1\n" + (">" + "." * 8 + "G.\n") * 1, "too many: at most 200 and 10 m"),
        (MAP.replace(".....G", ".#...#").replace(">.....", ">#...G"), "cannot be reached"),
        ("cell 0.03\n>.#.....\n....G...\n", "the start at .* is in a wall or close to one"),
        ("; nothing\n\n", "there is no map"),
    ],
)
def test_what_is_wrong_with_a_map_is_one_line(text, message):
    if message is None:
        assert plan_of(text).size == (6.0, 4.0)
        return
    for make in (lambda: KheperaMazeEnv(layout=text), lambda: settings.MazeConfig(layout=text)):
        with pytest.raises(ValueError, match=message) as error:
            make()
        assert "\n" not in str(error.value) and len(str(error.value)) < 250


def changed(change):
    """The standard maze with a change."""
    spec = mujoco.MjSpec.from_file(str(standard_path()))
    change(spec)
    return spec.to_xml()


def put(kind, **attributes):
    """Adds an element to the world."""
    return lambda spec: getattr(spec.worldbody, f"add_{kind}")(**attributes)


def set_(kind, name, attribute, value):
    return lambda spec: setattr(getattr(spec, kind)(name), attribute, value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_("geom", "wall_lower", "quat", [0.9, 0, 0, 0.1]), "wall_lower is no box along"),
        (set_("geom", "wall_lower", "type", CYLINDER), "wall_lower is no box"),
        (put("geom", name="pillar", size=[0.02] * 3, contype=2), "'pillar' stops the robot"),
        (put("site", name="subgoal1", pos=[0.5, 0.5, 0]), "'subgoal1' is not understood"),
        (put("site", name="Goal", pos=[0.5, 0.5, 0]), "'Goal' is not understood"),
        (put("site", name="goal_2", pos=[0.5, 0.5, 0], size=[0.06] * 3), "2 goals and no word"),
        (set_("site", "goal", "pos", [0.5, 0.333, 0]), "the goal at .* is in a wall"),
        (set_("site", "subgoal_1", "size", [0.05] * 3), "subgoals must have one radius"),
        (set_("geom", "wall_lower", "size", [0.7, 0.025, 0.02]), "cannot be reached"),
        (lambda spec: spec.delete(spec.geom("wall_north")), "goal at .* in a wall|could leave"),
        (set_("geom", "wall_west", "pos", [-0.21, 0.5, 0.02]), "must begin at|could leave"),
        (lambda spec: spec.add_text(name="goal", data="maybe"), "text goal must be any or vary"),
        (lambda spec: spec.delete(spec.site("goal")), "lacks an element.*goal"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_an_mjcf_is_one_line(change, message):
    text = changed(change)
    with pytest.raises(ValueError, match=message) as error:
        KheperaMazeEnv(layout=text)
    assert "\n" not in str(error.value) and len(str(error.value)) < 250


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco>\n<include file='walls.xml'/></mujoco>", "<include> needs another file"),
        ("<mujoco>\n<asset><mesh file='a.stl'/></asset></mujoco>", "<mesh> needs another file"),
        ("<mujoco>\n<worldbody>", "is no XML"),
        ("<mujoco>\n<walls/></mujoco>", "no MJCF model"),
        ("<mujoco>\n</mujoco>", "lacks an element"),
    ],
)
def test_an_mjcf_must_be_whole(text, message):
    with pytest.raises(ValueError, match=message):
        KheperaMazeEnv(layout=text)


def test_an_mjcf_of_the_standard_maze_is_the_standard_maze():
    assert plan_of(standard_path().read_text()) == plan_of("s")


@pytest.mark.parametrize("name", [n for n in NAMES if n != "s"])
def test_the_mjcf_of_a_map_is_that_map(name):
    plan = plan_of(name)
    assert plan_of(mjcf(name)) == plan
    model = load_model(name)
    camera, walls = model.camera("top"), np.array(plan.walls)
    half = np.abs(walls.reshape(-1, 2) - camera.pos[:2]).max()
    seen = (camera.pos[2] - 0.04) * math.tan(math.radians(camera.fovy[0]) / 2)
    assert 0.95 < half / seen < 1.0  # the view from above shows all of it
    assert Physics(name).pose() == pytest.approx(plan.start)


def test_random_mazes_differ_and_have_one_way_between_any_two_rooms():
    maps = {random_map(seed).partition("\n")[2] for seed in range(40)}
    assert len(maps) > 10  # three by three rooms from one corner allow no more than some dozens
    for text in itertools.islice(maps, 10):
        wall = np.array([[mark == "#" for mark in row] for row in text.split("\n")[1:18]])
        assert (~wall).sum() == 9 * 25 + 8 * 5  # nine rooms and the eight doors of a tree
        assert plan_of(text + "\n").reached.any()
    assert random_map(3) == random_map(3)


@pytest.mark.parametrize(
    ("name", "actions", "pose"),
    list(itertools.product(NAMES, ("three", "steer", "wheels"), ("estimated", "odometry", "true"))),
)
def test_in_every_maze_walls_hold_and_zones_count(name, actions, pose):
    env = KheperaMazeEnv(layout=name, actions=actions, pose=pose, motor_noise=0.0)
    plan, ahead = env.plan, {"three": 1, "steer": [0.0], "wheels": [1.0, 1.0]}[actions]
    env.reset(seed=0)
    env.action_space.seed(0)
    for i in range(12):
        action = env.action_space.sample() if i % 4 == 0 else ahead
        observation, _, terminated, _, info = env.step(action)
        x, y, _ = info["true_pose"]
        assert plan.clearance(x, y) > -0.0005
        assert observation in env.observation_space and len(env.axes) == len(observation)
        if terminated:
            env.reset()
    for number, (x, y) in enumerate(plan.goals):
        while True:  # until it is the goal of the trial
            env.reset()
            if not plan.told or env.goal == number:
                break
        env.physics.place((x - plan.goal_radius - 0.002, y, 0.0))
        assert env.step(ahead)[2]
    for number, (x, y) in enumerate(plan.subgoals):
        env.reset()
        env.physics.place((x, y, 0.0))
        assert env.step(ahead)[4]["subgoals"][number]


def test_starts_that_vary_are_all_drawn():
    env = KheperaMazeEnv(layout="starts")
    env.reset(seed=0)
    seen = {tuple(np.round(env.reset()[1]["true_pose"], 6)) for _ in range(40)}
    assert seen == {tuple(np.round(start, 6)) for start in env.plan.starts} and len(seen) == 4


def test_starts_anywhere_have_room_and_cover_the_floor():
    env = KheperaMazeEnv(layout="anywhere")
    env.reset(seed=0)
    poses = np.array([env.reset()[1]["true_pose"] for _ in range(200)])
    assert min(env.plan.clearance(x, y) for x, y, _ in poses) > 0.009
    assert min(math.dist(pose[:2], env.plan.goal) for pose in poses) > env.plan.goal_radius
    counts, *_ = np.histogram2d(*poses[:, :2].T, bins=3, range=[(0, 1.02)] * 2)
    assert counts.min() > 5
    assert np.ptp(poses[:, 2]) > 5


def test_of_any_goals_each_ends_the_trial_and_of_varying_ones_that_which_is_told():
    text = EMPTY.replace("cell 0.1", "goal any\ncell 0.1").replace(".....\n", "G....\n", 1)
    env = KheperaMazeEnv(layout=text)
    for x, y in env.plan.goals:
        env.reset(seed=0)
        env.physics.place((x, y, 0.0))
        assert env.step(1)[2]
    env = KheperaMazeEnv(layout=text.replace("goal any", "goal vary"))
    observation, _ = env.reset(seed=0)
    told = set()
    for _ in range(20):
        observation, info = env.reset()
        assert tuple(observation[3:]) == pytest.approx(env.plan.goals[env.goal], abs=1e-6)
        assert tuple(info["goal"]) == env.plan.goals[env.goal]
        told.add(env.goal)
        env.physics.place((*env.plan.goals[1 - env.goal], 0.0))
        assert not env.step(0)[2]
        env.physics.place((*env.plan.goals[env.goal], 0.0))
        other = KheperaMazeEnv(layout=env.settings.layout)
        other.load_state_dict(env.state_dict())
        assert env.step(0)[2] and other.step(0)[2]
    assert told == {0, 1}
    assert [axis.name for axis in env.axes][3:] == ["goal x", "goal y"]


def test_the_optimum_is_the_mean_over_starts_and_goals():
    plan = plan_of("starts")
    each = [optimal_steps(replace(plan, starts=[s]), 10, 0.01).steps for s in plan.starts]
    assert mean_optimum(plan, 10, 0.01) == np.mean(each)
    plan = plan_of("goals")
    each = [optimal_steps(replace(plan, goals=[g]), 10, 0.01).steps for g in plan.goals]
    assert mean_optimum(plan, 10, 0.01) == np.mean(each)


def test_the_way_into_a_spiral_winds_further_than_half_a_turn():
    best = optimal_steps(plan_of("spiral"), 10, 0.01)
    assert np.ptp([heading for *_, heading in best.path]) > 1.5 * math.pi
    assert 480 <= best.steps <= 520


@pytest.fixture
def drawn(quick, options, tmp_path):
    """A run in a map of a file that is gone."""
    file = tmp_path / "mine.txt"
    file.write_text(MAP)
    config = quick(trials=2, maze={"layout": file, "max_steps": 60})
    run = train(config, options)
    file.unlink()
    return run, options


def test_a_run_keeps_its_maze_when_the_file_is_gone_and_the_run_has_moved(drawn, tmp_path, call):
    run, options = drawn
    assert run.name == "sga-sofnn-own-estimated-s0"
    moved = tmp_path / "elsewhere" / "run"
    moved.parent.mkdir()
    shutil.move(run, moved)
    config, agent, *_ = evaluate.load(moved)
    assert make_plan(config).size == (0.6, 0.4)
    assert [a.high for a in agent.task.axes[:2]] == [0.6, 0.4]
    assert evaluate.evaluate(config, agent, 1)[0].steps <= 60
    assert evaluate.optimum(config) == mean_optimum(plan_of(MAP))
    assert resume(moved, options, 3) == moved
    code, out, _ = call(moved, "--at", 0.05, 0.05, 0)
    assert code == 0 and "x 50 mm" in out


def test_a_checkpoint_alone_keeps_its_maze(drawn, tmp_path):
    run, options = drawn
    alone = tmp_path / "alone.pt"
    shutil.copy(run / "checkpoint-2.pt", alone)
    assert session.saved_config(alone).maze.layout == MAP
    shutil.rmtree(run)
    assert evaluate.load(alone).config.maze.layout == MAP
    again = resume(alone, options, 3)
    assert evaluate.load(again).config.maze.layout == MAP


def test_a_run_of_before_there_were_layouts_goes_on(quick, options):
    run = train(quick(trials=2), options)
    file = run / "config.json"
    text = re.sub(r'\s*"layout": "s",', "", file.read_text())
    assert "layout" not in text
    file.write_text(text)
    for path in checkpoint.checkpoints(run):
        state = checkpoint.load(path)
        del state["config"]["maze"]["layout"]
        checkpoint.save(path, state)
    assert resume(run, options, 3) == run


def test_another_maze_on_resume_is_refused_in_a_short_line(drawn, tmp_path):
    from sofnn_torch.cli import parse as flags

    run, _ = drawn
    with pytest.raises(ValueError, match="contradicts") as error:
        flags(["--resume", str(run), "--maze.layout", "rooms"])
    assert "\n" not in str(error.value) and len(str(error.value)) < 350


def test_layouts_have_names_in_runs_and_are_settings():
    config = Config(maze=settings.MazeConfig(layout="random:3"))
    assert places.default_name(config) == "sga-sofnn-random-3-estimated-s0"
    assert places.default_name(Config()) == "sga-sofnn-estimated-s0"
    assert from_dict({"maze": {"layout": MAP}}).maze.layout == MAP
    with pytest.raises(ValueError, match=r"--maze\.layout nowhere\.txt: neither a file nor one of"):
        settings.MazeConfig(layout="nowhere.txt")
