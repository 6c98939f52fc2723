"""The progress of long jobs: readable at any width, few lines in a file, an honest time left."""

import fcntl
import os
import pty
import struct
import termios
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import settings

from sofnn_torch import evaluate, progress
from sofnn_torch.progress import Progress
from sofnn_torch.runs.factory import make_agent

FACTS = ["5,232 steps/s", "goal in 9 of 10", "512 steps", "577 rules"]


class Clock:
    """A clock that is put forward by hand."""

    def __init__(self):
        self.now = 1000.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def terminal(monkeypatch):
    """The error stream of progress is a terminal: one can resize it and read its screen."""
    master, slave = pty.openpty()
    stream = os.fdopen(slave, "w")
    monkeypatch.setattr(progress, "sys", SimpleNamespace(stderr=stream))
    monkeypatch.delenv("COLUMNS", raising=False)

    class Terminal:
        def resize(self, columns):
            fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("4H", 24, columns, 0, 0))

        def read(self):
            stream.flush()
            os.set_blocking(master, False)
            data = b""
            while True:
                try:
                    data += os.read(master, 4096)
                except BlockingIOError:
                    return data.decode()

    yield Terminal()
    os.close(master)


@pytest.mark.parametrize("width", [*range(60, 201), 300])
def test_a_line_of_any_width_has_speed_and_time_left(width, clock):
    bar = Progress("sga-sofnn-estimated-s0", 200, clock=clock)
    clock.now += 60
    bar.update(50, 60, FACTS)
    line = bar.line(width)
    assert len(line) <= width
    assert "50/200 [1:00<3:00, 5,232 steps/s" in line and line.endswith("]")
    if width >= 79:  # a terminal as it is opened: what was learned says more than the name
        assert all(fact in line for fact in FACTS)
    if width >= 120:
        assert "sga-sofnn-estimated-s0" in line and "##" in line and "--" in line


def test_a_very_narrow_line_still_has_the_time_left(clock):
    bar = Progress("sga-sofnn-estimated-s0", 200, clock=clock)
    clock.now += 60
    bar.update(50, 60, FACTS)
    assert bar.line(20).startswith("50/200 [1:00<3:00")


@pytest.mark.parametrize(
    "columns,environment,expected",
    [(100, "", 100), (0, "", 80), (0, "70", 70), (100, "0", 100), (100, "many", 100)],
)
def test_the_width_is_that_of_the_terminal(columns, environment, expected, terminal, monkeypatch):
    terminal.resize(columns)
    monkeypatch.setenv("COLUMNS", environment)
    assert progress.columns() == expected


def test_the_width_without_a_terminal(monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    monkeypatch.setattr(progress, "sys", SimpleNamespace(stderr=None))
    assert progress.columns() == 80


@pytest.mark.parametrize("columns", [0, 60, 120])
def test_a_bar_is_redrawn_in_place_and_messages_stand_above_it(columns, terminal, clock):
    terminal.resize(columns)
    with Progress("run", 10, clock=clock) as bar:
        for _ in range(9):
            clock.now += 1
            bar.update(facts=FACTS)
        progress.say("warning: so it is")
        clock.now += 1
        bar.update(facts=FACTS)
    screen = terminal.read().replace("\r\n", "\n")
    lines = [line.split("\r")[-1].strip() for line in screen.split("\n")]
    assert lines[0] == "warning: so it is" and lines[1] == bar.line((columns or 80) - 1).strip()
    assert "10/10 [0:10<0:00, 5,232 steps/s" in lines[1] and lines[2:] == [""]


def test_a_file_gets_few_lines_and_no_carriage_return(capsys, clock):
    with Progress("run", 1000, clock=clock) as bar:
        for _ in range(1000):
            clock.now += 1
            bar.update(facts=FACTS)
    written = capsys.readouterr().err
    assert "\r" not in written and len(written.splitlines()) == 10
    assert written.splitlines()[1] == f"run 200/1000 [3:20<13:20, {', '.join(FACTS)}]"


def test_a_short_job_leaves_a_file_empty(capsys, clock):
    with Progress("run", 100, clock=clock) as bar:
        for _ in range(100):
            clock.now += 0.01
            bar.update(facts=FACTS)
    assert not capsys.readouterr().err


def test_quiet_is_quiet(terminal, clock):
    with Progress("run", 2, quiet=True, clock=clock) as bar:
        bar.update()
    assert not terminal.read()


def test_a_long_unit_shows_where_it_is_until_it_is_done(terminal, clock):
    terminal.resize(100)
    with Progress("run", 10, clock=clock) as bar:
        clock.now += 0.5
        bar.within("trial 1: 700 steps")
        short = bar.line(99)
        clock.now += 3
        bar.within("trial 1: 5,200 steps")
        assert "0/10 [0:03<?, trial 1: 5,200 steps]" in terminal.read()
        bar.update(facts=FACTS)
        done = bar.line(99)
    assert "trial" not in short and "trial" not in done and FACTS[0] in done


@pytest.mark.parametrize("ending,frames", [("gif", 5), ("mp4", 11)])
def test_a_film_shows_how_far_it_is(ending, frames, terminal, tmp_path, monkeypatch):
    terminal.resize(100)
    pictures = [np.zeros((16, 16, 3), np.uint8)] * frames
    monkeypatch.setattr(evaluate, "film", lambda *_, **__: iter(pictures))
    evaluate.write_video(tmp_path / f"film.{ending}", settings(), None, 0, False, steps=20)
    assert f"{frames}/{frames} [" in terminal.read()


def test_a_video_does_not_spoil_the_time_left(clock):
    """Trials of a second and 50 seconds of video after every 50th: 200 trials take 400 s."""
    bar = Progress("run", 200, clock=clock)
    for trial in range(1, 201):
        clock.now += 1
        bar.update(seconds=1.0)
        if trial % 50 == 0:
            clock.now += 50
        if trial == 49:
            assert bar.left() == pytest.approx(151)  # of videos nothing is known yet
        if trial == 51:
            assert bar.left() == pytest.approx(149 + 149 * 50 / 51)
    assert bar.left() == 0


def test_the_time_left_follows_trials_that_become_shorter(clock):
    bar = Progress("run", 200, clock=clock)
    for trial in range(100):
        seconds = 10.0 if trial < 20 else 1.0
        clock.now += seconds
        bar.update(seconds=seconds)
    assert bar.left() == pytest.approx(100, rel=0.01)


def test_a_long_evaluation_shows_a_bar(terminal):
    terminal.resize(100)
    config = settings()
    agent = make_agent(config)
    agent.start(np.array([0.1, 0.1, 0.0]))
    evaluate.evaluate(config, agent, episodes=3, quiet=False)
    assert "evaluation 100%|####" in terminal.read()
