"""Pictures of the maze, drawn without a display."""

import contextlib
import ctypes.util
import importlib
import os
import subprocess
import sys

import numpy as np
import psutil
import pytest

from sofnn_torch.maze import rendering
from sofnn_torch.maze.env import STRAIGHT, KheperaMazeEnv
from sofnn_torch.maze.rendering import OffscreenRenderer, RenderingError
from sofnn_torch.maze.robot import load_model


def can_draw():
    """Return whether this machine has any OpenGL; where not, only messages can be tested."""
    try:
        OffscreenRenderer(load_model(), 16, 16).close()
    except RenderingError:
        return False
    return True


needs_gl = pytest.mark.skipif(not can_draw(), reason="no EGL, OSMesa or display")


@pytest.fixture(scope="module")
def draw():
    model = load_model()
    renderer = OffscreenRenderer(model, 160, 120)
    start = model.key("start").qpos
    yield lambda *args, **kwargs: renderer.draw(start, *args, **kwargs).astype(int)
    renderer.close()


@needs_gl
def test_pictures_show_the_maze(draw):
    top, chase = draw(), draw(camera="chase")
    for picture in (top, chase):
        assert picture.shape == (120, 160, 3)
        assert picture.std() > 15  # not a blank frame
        assert 60 < picture.mean() < 230  # neither dark nor burnt out
    assert np.abs(top - chase).mean() > 10
    assert (draw() == top).all()


@needs_gl
def test_the_goal_is_green_and_in_the_north_east(draw):
    picture = draw()
    red, green, blue = picture.transpose(2, 0, 1)
    rows, columns = np.nonzero((green > red + 40) & (green > blue + 30))
    assert np.median(rows) < 40 and np.median(columns) > 100


@needs_gl
def test_trail_and_ghost_are_drawn_where_they_are(draw):
    plain = draw()
    trail = draw([(0.2, 0.15), (0.5, 0.15), (0.5, 0.15), (0.8, 0.15)])
    rows, columns = np.nonzero(np.abs(trail - plain).max(axis=2) > 30)
    assert rows.size and (rows > 90).all() and (rows < 110).all()  # y = 0.15 m, seen from above
    ghost = draw(estimate=(0.5, 0.85, 0.3))
    rows, columns = np.nonzero(np.abs(ghost - plain).max(axis=2) > 20)
    assert np.median(columns) == pytest.approx(80, abs=6) and np.median(rows) < 30


@needs_gl
def test_a_very_long_trail_is_thinned_out(draw):
    way = np.random.default_rng(0).uniform(0.1, 0.9, (20_000, 2))
    assert np.abs(draw(way.tolist()) - draw()).mean() > 5
    waiting = [(0.2, 0.15)] * 20_000
    moved = np.abs(draw([*waiting, (0.8, 0.15)]) - draw(waiting)).max(axis=2) > 30
    assert moved.sum() > 50  # its end is drawn, however long it has stood before


@needs_gl
def test_the_environment_draws_itself():
    env = KheperaMazeEnv(render_mode="rgb_array", width=96, height=64)
    env.reset(seed=0)
    before = env.render()
    env.step(STRAIGHT)
    after = env.render()
    assert before.shape == (64, 96, 3) and before.dtype == np.uint8
    assert (before != after).any()
    env.camera = "chase"
    assert (env.render() != after).any()
    env.close()
    env.close()


def open_files():
    """Where the open files of this process lead."""
    found = []
    for name in os.listdir("/dev/fd"):
        with contextlib.suppress(OSError):  # the listing's own
            found.append(os.readlink(f"/dev/fd/{name}"))
    return sorted(found)


@needs_gl
@pytest.mark.parametrize("count", [4, pytest.param(100, marks=pytest.mark.slow)])
def test_many_mazes_that_draw_leave_nothing_behind(count, monkeypatch):
    backend = importlib.import_module(rendering.BACKENDS[rendering.choose_backend()][0])
    opened, freed = [], []

    class Counted(backend.GLContext):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            opened.append(self)

        def free(self):
            super().free()
            freed.append(self)

    monkeypatch.setattr(backend, "GLContext", Counted)
    process = psutil.Process()

    def live():
        env = KheperaMazeEnv(render_mode="rgb_array", width=32, height=32)
        env.reset(seed=0)
        env.step(STRAIGHT)
        assert env.render().std() > 15
        env.close()
        return open_files(), process.num_threads(), process.memory_info().rss / 2**20

    *before, start = live()
    for _ in range(count - 1):
        *after, memory = live()
    assert len(opened) == count and freed == opened
    assert after == before
    # Buffers of the allowed 1,600 x 1,600 pixels: a hundred of them would be gigabytes.
    assert memory < start + 300


@needs_gl
def test_unknown_cameras_and_sizes_are_refused(draw):
    with pytest.raises(ValueError, match=r"\['top', 'chase'\]"):
        draw(camera="side")
    with pytest.raises(ValueError, match="not 9000 x 64"):
        OffscreenRenderer(load_model(), 9000, 64)


def test_rendering_needs_a_mode():
    env = KheperaMazeEnv()
    env.reset()
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


@pytest.fixture
def headless(monkeypatch):
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    return monkeypatch


def test_egl_is_preferred_then_osmesa(headless):
    installed = {"EGL", "OSMesa"}
    headless.setattr(ctypes.util, "find_library", lambda name: name in installed or None)
    assert rendering.choose_backend() == "egl"
    installed.remove("EGL")
    assert rendering.choose_backend() == "osmesa"
    headless.setenv("MUJOCO_GL", "EGL")
    assert rendering.choose_backend() == "egl"
    headless.delenv("MUJOCO_GL")
    headless.setenv("DISPLAY", ":0")
    assert rendering.choose_backend() == "glfw"
    headless.setattr(sys, "platform", "darwin")
    assert rendering.choose_backend() == "cgl"


def test_without_opengl_one_line_says_what_to_install(headless):
    headless.setattr(ctypes.util, "find_library", lambda name: None)
    env = KheperaMazeEnv(render_mode="rgb_array")
    env.reset()
    with pytest.raises(RenderingError, match=r"libegl1.*libosmesa6") as error:
        env.render()
    assert "\n" not in str(error.value)


LIBRARIES = [("egl", "EGL"), ("osmesa", "OSMesa")]
MAZE = """
import os, sys, threading
os.environ["MUJOCO_GL"] = sys.argv[1]
import gymnasium

def maze():
    env = gymnasium.make(
        "sofnn_torch:KheperaMaze-v0", render_mode="rgb_array", width=32, height=32
    )
    env.reset(seed=0)
    return env

env = maze()
expected = env.render()
"""


def outcome(code, backend, library):
    """What a program prints that draws with a backend."""
    if not (sys.platform == "linux" and ctypes.util.find_library(library)):
        pytest.skip(f"{library} is not installed")
    variables = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    command = [sys.executable, "-c", code, backend]
    run = subprocess.run(command, capture_output=True, text=True, env=variables, timeout=120)
    assert run.returncode == 0 and run.stderr == "", run.stderr
    return run.stdout.split("\n")[:-1]


@pytest.mark.parametrize(("backend", "library"), LIBRARIES)
def test_a_backend_works_although_mujoco_was_imported_before(backend, library):
    code = f"import mujoco{MAZE}env.close()\nprint(expected.std() > 15, maze().render().std() > 15)"
    assert outcome(code, backend, library) == ["True True"]


@pytest.mark.parametrize(("backend", "library"), LIBRARIES)
def test_any_thread_draws_the_same_and_nothing_need_be_closed(backend, library):
    code = f"""{MAZE}
def draw(env):
    print((env.render() == expected).all(), flush=True)

others = [env, env, maze(), maze()]
threads = [threading.Thread(target=draw, args=(each,)) for each in others]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
draw(others[2])  # made in this thread, first drawn in another
others[3].close()
env.me = env  # as in a notebook: nothing is deleted before the end
"""
    assert outcome(code, backend, library) == ["True"] * 5


@pytest.mark.parametrize(("backend", "library"), LIBRARIES)
def test_after_a_fork_a_process_ends_as_any_other_and_one_line_says_that_it_cannot_draw(
    backend, library
):
    code = f"""{MAZE}
if not (quiet := os.fork()):
    sys.exit()  # as any other process ends
print(os.waitpid(quiet, 0)[1], flush=True)
if not (child := os.fork()):
    for draw in (env.render, lambda: maze().render()):
        try:
            draw()
        except ValueError as error:
            print(type(error).__name__, error, flush=True)
    env.close()
    os._exit(7)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), (env.render() == expected).all())
"""
    ended, *said, parent = outcome(code, backend, library)
    assert ended == "0"
    assert len(said) == 2 and parent == "7 True"
    assert all(line.startswith("RenderingError cannot draw") and "spawn" in line for line in said)


def test_the_first_to_draw_may_be_a_fork():
    code = MAZE.replace("env = maze()", "child = os.fork()\nenv = maze()")
    code += "print(expected.std() > 15, flush=True)\nif child: os.waitpid(child, 0)"
    assert outcome(code, "egl", "EGL") == ["True", "True"]


@needs_gl
def test_a_closed_renderer_says_so():
    renderer = OffscreenRenderer(load_model(), 16, 16)
    renderer.close()
    renderer.close()
    with pytest.raises(RenderingError, match="closed"):
        renderer.draw(load_model().key("start").qpos)


@needs_gl
def test_a_renderer_that_is_forgotten_frees_its_context():
    renderer = OffscreenRenderer(load_model(), 16, 16)
    number = len(rendering._contexts)
    del renderer
    OffscreenRenderer(load_model(), 16, 16).close()  # waits for what was asked before
    assert len(rendering._contexts) == number - 1
