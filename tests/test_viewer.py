"""The viewer window, mostly without one: a stand-in notes what the viewer is told to show."""

import contextlib
import os
import shutil
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import mujoco
import pytest

from sofnn_torch import evaluate
from sofnn_torch.maze import viewer
from sofnn_torch.maze.env import LEFT, STRAIGHT, KheperaMazeEnv
from sofnn_torch.maze.rendering import RenderingError
from sofnn_torch.maze.robot import load_model
from sofnn_torch.maze.viewer import Viewer


class Window:
    """What `mujoco.viewer.launch_passive` returns."""

    def __init__(self, model, data, key_callback, **_):
        self.press, self.data, self.open, self.frames, self.texts = key_callback, data, True, 0, []
        self.cam, self.opt = mujoco.MjvCamera(), mujoco.MjvOption()
        self.user_scn = mujoco.MjvScene(model, maxgeom=1000)
        self.lock = contextlib.nullcontext

    def is_running(self):
        return self.open

    def set_texts(self, texts):
        self.texts = texts

    def sync(self):
        self.frames += 1

    def close(self):
        self.open = False

    def shown(self):
        """Names and values of the text in the corner."""
        _, _, names, values = self.texts[0]
        return dict(zip(names.split("\n"), values.split("\n"), strict=True))


@pytest.fixture
def windows(monkeypatch):
    """The windows that were opened."""
    opened = []

    def launch(*arguments, **settings):
        opened.append(Window(*arguments, **settings))
        return opened[-1]

    library = SimpleNamespace(launch_passive=launch)
    monkeypatch.setattr(mujoco, "viewer", library, raising=False)
    monkeypatch.setitem(sys.modules, "mujoco.viewer", library)
    monkeypatch.setattr(viewer, "has_display", lambda: True)
    monkeypatch.setattr(viewer, "_check_display", lambda: None)
    monkeypatch.setattr(viewer, "PAUSED_FRAME", 0.001)
    return opened


@pytest.fixture
def maze(windows):
    env = KheperaMazeEnv(render_mode="human", speed=1000.0, motor_noise=0.0)
    env.reset(seed=0)
    yield env
    env.close()


def test_the_window_shows_every_step_with_trial_time_decision_and_rule(maze, windows):
    (window,) = windows
    assert window.shown() == {"trial": "1", "time": "0.0 s", "decision": "0", "speed": "1000 x"}
    maze.step(STRAIGHT)
    maze.caption = "12: x low"
    maze.step(LEFT)
    assert window.frames == 21
    assert window.shown() == {
        "trial": "1", "time": "10.0 s", "decision": "2", "rule": "12: x low", "speed": "1000 x"
    }  # fmt: skip
    assert window.data.qpos[:2] == pytest.approx(maze.physics.position())
    assert window.user_scn.ngeom > 10  # trail and ghost
    maze.reset()
    assert window.shown()["trial"] == "2" and "rule" not in window.shown()


def test_the_space_bar_pauses_and_the_right_arrow_makes_one_step(maze, windows):
    (window,) = windows
    window.press(viewer.RIGHT_ARROW)  # which does nothing before the pause
    window.press(viewer.SPACE)
    driver = threading.Thread(target=maze.step, args=(STRAIGHT,), daemon=True)
    driver.start()

    def settled(steps):
        end = time.monotonic() + 20
        while round(maze.physics.data.time / 0.5) < steps and time.monotonic() < end:
            time.sleep(0.01)
        seen = window.frames
        while window.frames < seen + 20 and time.monotonic() < end:  # it waits, and still draws
            time.sleep(0.01)
        return round(maze.physics.data.time / 0.5)

    assert settled(1) == 1 and window.shown()["speed"] == "paused"
    window.press(viewer.RIGHT_ARROW)
    assert settled(2) == 2 and driver.is_alive()
    window.press(viewer.SPACE)
    driver.join(20)
    assert not driver.is_alive() and maze.total_steps == 10


def test_a_window_that_is_closed_in_a_pause_lets_the_robot_go_on(maze, windows):
    (window,) = windows
    window.press(viewer.SPACE)
    driver = threading.Thread(target=maze.step, args=(STRAIGHT,), daemon=True)
    driver.start()
    time.sleep(0.5)  # it waits by now
    window.open = False
    driver.join(20)
    assert not driver.is_alive() and maze.total_steps == 10


def test_keys_change_the_speed_within_bounds(windows):
    model = load_model()
    view = Viewer(model, speed=20.0)
    for key, speed in ((viewer.PLUS[0], 40.0), (viewer.PLUS[1], 80.0), (viewer.MINUS[0], 40.0)):
        windows[0].press(key)
        assert view.speed == speed
    for _ in range(20):
        windows[0].press(viewer.MINUS[1])
    assert view.speed == viewer.SLOWEST
    for _ in range(20):
        windows[0].press(viewer.PLUS[0])
    assert view.speed == viewer.FASTEST
    view.close()


def test_a_frame_waits_for_its_turn(windows, monkeypatch):
    view, slept = Viewer(load_model(), speed=5.0), []
    clock = SimpleNamespace(monotonic=lambda: 100.0, sleep=slept.append)
    monkeypatch.setattr(viewer, "time", clock)
    for _ in range(2):
        view.draw(load_model().key("start").qpos)
    assert slept == pytest.approx([0.0, 0.1])  # half a second of the robot's, 5 times as fast
    view.close()


def test_a_key_follows_the_robot_and_stops_to(windows):
    model = load_model()
    view = Viewer(model, 1000.0)
    start, camera = model.key("start").qpos, windows[0].cam
    kinds = []
    for _ in range(3):
        view.draw(start)
        kinds.append(camera.type)
        windows[0].press(viewer.ENTER[0])
    free, fixed = mujoco.mjtCamera.mjCAMERA_FREE, mujoco.mjtCamera.mjCAMERA_FIXED
    assert kinds == [free, fixed, free]
    assert camera.fixedcamid in (-1, model.camera("chase").id)
    view.close()
    chasing = Viewer(model, 1000.0, "chase")
    chasing.draw(start)
    assert windows[1].cam.fixedcamid == model.camera("chase").id
    chasing.close()


def test_a_window_does_not_survive_a_fork(windows, monkeypatch):
    view = Viewer(load_model())
    monkeypatch.setattr(os, "getpid", lambda: -1)
    with pytest.raises(RenderingError, match="forked"):
        view.draw(load_model().key("start").qpos)
    view.close()
    assert windows[0].open  # it is its owner's
    monkeypatch.undo()
    view.close()


@pytest.fixture
def headless(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")


def test_without_a_display_the_message_says_what_to_do_instead(headless, tmp_path):
    with pytest.raises(RenderingError, match=r'display.*render_mode="rgb_array"'):
        Viewer(load_model())
    with pytest.raises(RenderingError, match="display"):
        KheperaMazeEnv(render_mode="human").reset()
    with pytest.raises(ValueError, match=r"--viewer needs a display.*--video FILE"):
        evaluate.run(evaluate.Options(run=tmp_path, viewer=True))


@pytest.mark.skipif(sys.platform != "linux", reason="there are displays of X only on Linux")
def test_a_display_that_does_not_answer_is_one_line():
    code = "from sofnn_torch.maze.env import *; KheperaMazeEnv(render_mode='human').reset()"
    command, variables = [sys.executable, "-c", code], os.environ | {"DISPLAY": ":7733"}
    variables.pop("WAYLAND_DISPLAY", None)
    done = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith("cannot open the viewer: no display answers")


@pytest.mark.skipif(not shutil.which("xvfb-run"), reason="xvfb is not installed")
def test_a_real_window_opens_draws_and_closes_also_at_the_end():
    code = """
from sofnn_torch.maze.env import KheperaMazeEnv
env = KheperaMazeEnv(render_mode="human", speed=1000.0, hold=2)
env.reset(seed=0)
env.step(1)
env.close()
env.step(1)
env._renderer._key(32)
env._renderer._key(32)
env.step(2)
print(env.total_steps, env._renderer._handle.is_running())
"""
    command = ["xvfb-run", "-a", sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "6 True\n"), done.stderr
