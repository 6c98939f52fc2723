"""TensorBoard files: documented names, one run after a resume, and no harm to the training."""

import io
import re
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from PIL import Image
from tensorboard.backend.event_processing import plugin_event_accumulator
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from sofnn_torch.maze.env import KheperaMazeEnv
from sofnn_torch.maze.layouts import standard_path
from sofnn_torch.maze.rendering import RenderingError
from sofnn_torch.pictures import events as events_module
from sofnn_torch.pictures import film as film_module
from sofnn_torch.pictures.events import EventFile
from sofnn_torch.pictures.film import film, gif
from sofnn_torch.pictures.tensorboard import Monitor
from sofnn_torch.runs import seeding
from sofnn_torch.runs.directory import flatten
from sofnn_torch.runs.factory import make_agent, make_env
from sofnn_torch.runs.settings import Config
from sofnn_torch.runs.trial import Trajectory
from sofnn_torch.training import play

METRICS = Path(__file__).parents[1] / "docs" / "metrics.md"


def settings(kind="sga", **maze):
    config = Config(agent=kind, network="sofnn")
    return replace(config, maze=replace(config.maze, **{"max_steps": 150, **maze}))


@pytest.fixture(scope="module", params=["sga", "q"])
def played(request):
    """Settings, learner, record and path of one short trial."""
    config = settings(request.param)
    agent, env = make_agent(config), make_env(config)
    record, path = play(env, agent)
    env.close()
    return config, agent, replace(record, trial=1), path


@pytest.fixture
def sga_trial():
    config = settings()
    agent, env = make_agent(config), make_env(config)
    record, path = play(env, agent)
    env.close()
    return config, agent, replace(record, trial=1), path


def events(run_dir):
    accumulator = EventAccumulator(str(run_dir), size_guidance={"images": 0, "scalars": 0})
    accumulator.Reload()
    return accumulator


def scalar(accumulator, name):
    """Values of a scalar by step."""
    return {event.step: event.value for event in accumulator.Scalars(name)}


def changed(config):
    """Settings that are not those of the preset, by dotted names."""
    ours, usual = (flatten(asdict(c)) for c in (config, Config(agent=config.agent)))
    return {name for name in ours if ours[name] != usual[name]}


def numbered(record, trial, **changes):
    return replace(record, trial=trial, **changes)


def test_every_scalar_is_documented_and_has_its_value(tmp_path, played):
    config, agent, record, path = played
    monitor = Monitor(tmp_path, config, picture_every=0, video_every=0)
    monitor.trial(record, path, agent, steps_per_second=1234.5)
    monitor.close()
    found = events(tmp_path)
    names = {tag for tag in found.Tags()["scalars"]}
    documented = set(re.findall(r"`([a-z_0-9]+/[a-z_0-9]+)`", METRICS.read_text()))
    assert names <= documented
    assert {
        "1_result/steps",
        "rules/count",
        "pose/error_mean",
        "learning/error_rms_sga",
    } <= names or config.agent == "q"
    assert scalar(found, "1_result/steps") == {1: record.steps}
    assert scalar(found, "rules/count") == {1: record.rules}
    assert scalar(found, "speed/steps_per_second") == {1: 1234.5}
    assert scalar(found, "pose/error_mean")[1] == pytest.approx(record.measures["pose_error"])
    for name, value in record.statistics.items():
        own = f"_{config.agent}" * (name == "learning/error_rms")
        assert scalar(found, name + own)[1] == pytest.approx(value)
    assert min(names) == "1_result/return"  # the group that TensorBoard shows first


def test_settings_are_hparams_of_the_same_run(tmp_path, sga_trial):
    config, agent, record, path = sga_trial
    monitor = Monitor(tmp_path, replace(config, seed=42), picture_every=0)
    monitor.trial(record, path, agent, 1.0)
    monitor.close()
    assert [p.name for p in tmp_path.iterdir() if p.is_dir()] == []
    content = events(tmp_path).summary_metadata["_hparams_/session_start_info"]
    hparams = HParamsPluginData.FromString(content.plugin_data.content).session_start_info.hparams
    assert hparams["seed"].number_value == 42
    assert hparams["agent"].string_value == "sga"
    assert set(hparams) == {*"env agent network pose preset seed".split(), *changed(config)}
    (settings,) = events(tmp_path).Tensors("settings/text_summary")
    said = settings.tensor_proto.string_val[0].decode()
    assert f"    net.theta = {config.net.theta}\n" in said and "    seed = 42\n" in said


def test_resume_hides_what_the_interrupted_run_wrote_after_its_checkpoint(tmp_path, sga_trial):
    config, agent, record, path = sga_trial
    first = Monitor(tmp_path, config, picture_every=0)
    for trial in (1, 2, 3):
        first.trial(numbered(record, trial, steps=trial), path, agent, 1.0)
    first.close()
    second = Monitor(tmp_path, config, first_trial=2, picture_every=0)
    second.trial(numbered(record, 2, steps=20), path, agent, 1.0)
    second.close()
    assert scalar(events(tmp_path), "1_result/steps") == {1: 1, 2: 20}
    shown = plugin_event_accumulator.EventAccumulator(str(tmp_path))  # what TensorBoard reads with
    shown.Reload()
    assert [event.step for event in shown.Tensors("1_result/steps")] == [1, 2]


def test_moving_success_rate_goes_on_after_a_resume(tmp_path, sga_trial):
    config, agent, record, path = sga_trial
    rows = [f"{trial},{trial > 6}" for trial in range(1, 13)]  # the last two will be replayed
    (tmp_path / "trials.csv").write_text("\n".join(["trial,success", *rows]) + "\n")
    monitor = Monitor(tmp_path, config, first_trial=11, picture_every=0)
    for trial in (11, 12):
        monitor.trial(numbered(record, trial, success=False), path, agent, 1.0)
    monitor.close()
    # Trials 2..11: 7, 8, 9 and 10 reached the goal; 3..12 the same.
    assert scalar(events(tmp_path), "1_result/success_last_10") == pytest.approx({11: 0.4, 12: 0.4})


def test_pictures_come_when_due_and_leave_the_learner_alone(tmp_path, played):
    config, agent, record, path = played
    before = agent.state_dict()["rng"], agent.net.table().detach().clone(), agent.net.usage.clone()
    monitor = Monitor(tmp_path, config, picture_every=2, video_every=0)
    for trial in (1, 2, 3):
        monitor.trial(numbered(record, trial), path, agent, 1.0)
    monitor.close()
    found = events(tmp_path)
    names = {"trajectory", "rules", "policy", "value", "pose_error"}
    assert set(found.Tags()["images"]) == {f"pictures/{name}" for name in names}
    for name in names:
        (image,) = found.Images(f"pictures/{name}")
        assert image.step == 2
        assert (image.width, image.height) == (800, 800)
        assert image.encoded_image_string.startswith(b"\x89PNG")
    rng, table, usage = before
    assert agent.state_dict()["rng"] == rng
    assert (agent.net.table() == table).all()
    assert (agent.net.usage == usage).all()


def test_a_directory_that_cannot_be_written_costs_one_warning(tmp_path, sga_trial, capsys):
    config, agent, record, path = sga_trial
    blocked = tmp_path / "file"
    blocked.write_text("")
    monitor = Monitor(blocked, config, picture_every=2)
    for trial in (1, 2):
        monitor.trial(numbered(record, trial), path, agent, 1.0)
    monitor.flush()
    monitor.close()
    warnings = capsys.readouterr().err.strip().splitlines()
    assert len(warnings) == 1
    assert "no TensorBoard" in warnings[0]


def test_a_full_disk_costs_one_warning_and_what_it_refused(
    tmp_path, sga_trial, capsys, monkeypatch
):
    config, agent, record, path = sga_trial
    monitor = Monitor(tmp_path, config, picture_every=3, video_every=0)

    def full(*_args):
        raise OSError(28, "No space left on device")

    monitor.trial(record, path, agent, 1.0)
    with monkeypatch.context() as disk:
        disk.setattr(EventFile, "_add", full)
        for trial in (2, 3):
            monitor.trial(numbered(record, trial), path, agent, 1.0)
    monitor.trial(numbered(record, 4), path, agent, 1.0)
    monitor.close()
    (warning,) = capsys.readouterr().err.strip().splitlines()
    assert "no TensorBoard" in warning
    assert "No space left" in warning
    assert list(scalar(events(tmp_path), "1_result/steps")) == [1, 4]


def test_no_rendering_costs_one_warning_and_the_video(tmp_path, sga_trial, capsys, monkeypatch):
    config, agent, record, path = sga_trial

    def no_gl(*_args):
        raise RenderingError("cannot draw without a display:\ninstall EGL")

    monkeypatch.setattr(film_module, "OffscreenRenderer", no_gl)
    monitor = Monitor(tmp_path, config, picture_every=0, video_every=1)
    for trial in (1, 2):
        monitor.trial(numbered(record, trial), path, agent, 1.0)
    monitor.close()
    (warning,) = capsys.readouterr().err.strip().splitlines()
    assert "no video" in warning
    assert "install EGL" in warning
    assert list(scalar(events(tmp_path), "1_result/steps")) == [1, 2]


def test_a_deleted_event_file_is_made_anew(tmp_path, sga_trial):
    config, agent, record, path = sga_trial
    monitor = Monitor(tmp_path, config, picture_every=0)
    monitor.trial(record, path, agent, 1.0)
    monitor.flush()
    for file in tmp_path.iterdir():
        file.unlink()
    monitor.trial(numbered(record, 2), path, agent, 1.0)
    monitor.close()
    assert list(scalar(events(tmp_path), "1_result/steps")) == [2]


class Camera:
    """A renderer whose frames tell where the robot is."""

    closed = 0

    def __init__(self, model, width, height):
        self.scene = SimpleNamespace(flags=np.ones(20))

    def draw(self, qpos, trail, estimate):
        return np.array([[qpos[:2]]] * 2)

    def close(self):
        Camera.closed += 1


@pytest.mark.parametrize("explore", [False, True])
def test_the_film_shows_the_trial_that_evaluation_plays(sga_trial, monkeypatch, explore):
    config, agent, _, _ = sga_trial
    env = make_env(config)
    seeding.begin(env, agent, 5)
    _, path = play(env, agent, learn=False, explore=explore)
    env.close()
    rng, before_film = agent.rng, agent.rng.random() and agent.rng.bit_generator.state
    monkeypatch.setattr(film_module, "OffscreenRenderer", Camera)
    before = Camera.closed
    frames = list(film(config, agent, seed=5, explore=explore, steps_per_frame=4))
    assert len(frames) == 1 + 150 // 4 + 1  # the start, every fourth step, the end
    assert frames[0][0, 0] == pytest.approx(path.true[0, :2])
    assert frames[-1][0, 0] == pytest.approx(path.true[-1, :2])
    assert agent.rng is rng and rng.bit_generator.state == before_film
    assert Camera.closed == before + 1


def test_an_animation_shows_a_dozen_frames_a_second_for_ever():
    data = gif(iter(np.random.default_rng(0).integers(0, 255, (3, 8, 8, 3), np.uint8)))
    picture = Image.open(io.BytesIO(data))
    assert picture.n_frames == 3 and picture.info["loop"] == 0
    assert picture.info["duration"] == pytest.approx(1000 / 12, abs=10)  # in hundredths of a second


def test_a_film_of_a_robot_that_does_not_arrive_ends(sga_trial, monkeypatch):
    config, agent, _, _ = sga_trial
    monkeypatch.setattr(film_module, "OffscreenRenderer", Camera)
    assert len(list(film(config, agent, steps_per_frame=10, limit=50))) <= 7


def test_a_film_shows_the_maze_that_the_robot_is_in(sga_trial, monkeypatch, tmp_path):
    config, agent, _, _ = sga_trial
    spec = mujoco.MjSpec.from_file(str(standard_path()))
    spec.delete(spec.geom("wall_lower"))
    path = tmp_path / "maze.xml"
    path.write_text(spec.to_xml())
    shown = []

    class Screen(Camera):
        def __init__(self, model, *size):
            shown.append([model.geom(i).name for i in range(model.ngeom)])
            super().__init__(model, *size)

    monkeypatch.setattr(film_module, "OffscreenRenderer", Screen)
    monkeypatch.setattr(film_module, "make_maze", lambda _: KheperaMazeEnv(layout=path))
    next(film(config, agent))
    assert "wall_upper" in shown[0] and "wall_lower" not in shown[0]


def test_a_gif_has_all_frames():
    frames = [np.full((24, 32, 3), 40 * i, np.uint8) for i in range(5)]
    picture = Image.open(io.BytesIO(gif(iter(frames))))
    assert (picture.format, picture.size, picture.n_frames) == ("GIF", (32, 24), 5)


def test_the_states_of_the_decisions_are_those_that_the_robot_knew():
    true, estimated = np.arange(9.0).reshape(3, 3), -np.arange(9.0).reshape(3, 3)
    path = Trajectory(true, estimated)
    np.testing.assert_array_equal(path.decided_at("true"), true[:2])
    for pose in ("estimated", "odometry"):
        np.testing.assert_array_equal(path.decided_at(pose), estimated[:2])


def test_files_are_read_in_the_order_of_the_sessions_if_the_clock_goes_back(tmp_path, monkeypatch):
    for now, first, value in ((2e9, 1, 1.0), (1e9, 2, 2.0), (5.0, 3, 3.0)):
        monkeypatch.setattr(events_module.time, "time", lambda now=now: now)
        file = EventFile(tmp_path, first)
        for step in range(first, 5):
            file.add(Summary(value=[Summary.Value(tag="x", simple_value=value)]), step)
        file.close()
    accumulator = EventAccumulator(str(tmp_path))
    accumulator.Reload()
    curve = [(e.step, e.value) for e in accumulator.Scalars("x")]
    assert curve == [(1, 1.0), (2, 2.0), (3, 3.0), (4, 3.0)]
