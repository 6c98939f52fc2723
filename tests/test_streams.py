"""Output that nobody reads, Ctrl-C, hints that can be pasted: the job goes on or says so."""

import io
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import equal, quick_options, settings

from sofnn_torch import cli, evaluate, progress, streams, terminal, training
from sofnn_torch.maze import optimum
from sofnn_torch.rules import __main__ as rules
from sofnn_torch.runs import checkpoint
from sofnn_torch.studies import __main__ as studies

ROOT = Path(__file__).parents[1]
QUICK = ["--trials=2", "--picture-every=0", "--video-every=0", "--maze.max-steps=100"]


def left():
    """A stream whose reader has left."""
    reader, writer = os.pipe()
    os.close(reader)
    return os.fdopen(writer, "w")


@pytest.fixture
def full():
    """A stream whose reader reads nothing, and whose pipe is full."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with pytest.raises(BlockingIOError):
        while True:
            os.write(writer, bytes(4096))
    os.set_blocking(writer, True)
    yield os.fdopen(writer, "w")
    os.close(reader)


def full_disk():
    """A stream into a disk that is full."""
    return os.fdopen(os.open("/dev/full", os.O_WRONLY), "w")


@pytest.fixture(params=["reader left", "full pipe", "full disk", "closed", "none"])
def deaf(request, full, monkeypatch):
    """An error stream to which nothing can be written."""
    monkeypatch.setattr(progress, "APART", 0.0)  # a line for every trial
    monkeypatch.setattr(streams, "PATIENCE", 0.01)
    closed = left()
    closed.close()
    return {
        "reader left": left(),
        "full pipe": full,
        "full disk": full_disk(),
        "closed": closed,
        "none": None,
    }[request.param]


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The end of a run of which everything could be said."""
    run = training.train(settings(), quick_options(tmp_path_factory.mktemp("reference")))
    return checkpoint.find_latest(run)[1]


def test_training_goes_on_whatever_becomes_of_its_messages(deaf, reference, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", deaf)
        run = training.train(settings(), quick_options(tmp_path, quiet=False))
        assert sys.stderr is deaf
    assert equal(checkpoint.find_latest(run)[1], reference)


def test_a_command_ends_with_0_where_its_messages_are_not_read(deaf, tmp_path, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", deaf)
        assert cli.main([*QUICK, "--runs", str(tmp_path), "--name", "run"]) == 0
    assert checkpoint.find_latest(tmp_path / "run")[1]["trial"] == 2


def test_bad_input_has_its_exit_code_where_its_message_is_not_read(deaf, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", deaf)
        assert cli.main(["--trials", "many"]) == 2


def test_a_reader_of_results_that_leaves_is_no_error(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stdout", left())
    assert cli.main([*QUICK, "--runs", str(tmp_path), "--quiet"]) == 0


def test_results_that_cannot_be_written_are_an_error_after_all_is_done(
    tmp_path, monkeypatch, capsys
):
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", full_disk())
        assert cli.main([*QUICK, "--runs", str(tmp_path), "--name", "run", "--quiet"]) == 1
    assert capsys.readouterr().err == (
        "error: the output cannot be written (No space left on device)\n"
    )
    assert checkpoint.find_latest(tmp_path / "run")[1]["trial"] == 2


def test_a_slow_reader_of_results_gets_all_of_them(monkeypatch):
    reader, writer = os.pipe()
    child = subprocess.Popen(["sh", "-c", "sleep 0.5; wc -c"], stdin=reader, stdout=subprocess.PIPE)
    os.close(reader)
    stream = os.fdopen(writer, "w")
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", stream)
        with streams.output():
            print("x" * 300_000)
    stream.close()
    assert child.communicate()[0].split() == [b"300001"]


def test_the_place_of_a_closed_descriptor_is_taken():
    number = os.dup(1)
    os.close(number)
    streams._occupy(number)
    assert os.path.samestat(os.fstat(number), os.stat(os.devnull))
    os.close(number)


# ------------------------------------------------------------------------------------------ Ctrl-C


def interrupt(*_):
    raise KeyboardInterrupt


@pytest.mark.parametrize("command", [evaluate, rules, optimum, studies])
def test_ctrl_c_ends_a_command_in_one_line(command, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["command", *["run"] * (command in (evaluate, rules))])
    monkeypatch.setattr(command, "run", interrupt)
    with pytest.raises(SystemExit) as stop:
        command.main()
    assert stop.value.code == 130
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("stopped")


def test_ctrl_c_is_one_line_where_it_killed_while_libraries_loaded(capsys):
    former = signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        assert terminal.attempt(lambda: os.kill(os.getpid(), signal.SIGINT) or time.sleep(9)) == 130
        assert signal.getsignal(signal.SIGINT) == signal.SIG_DFL
    finally:
        signal.signal(signal.SIGINT, former)
    assert capsys.readouterr().err == "stopped\n"


def test_ctrl_c_while_libraries_load_leaves_no_traceback():
    command = [sys.executable, "-X", "importtime", "-m", "sofnn_torch.evaluate", "nowhere"]
    child = subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    for line in child.stderr:
        if "tyro" in line or "scipy" in line:  # after the package itself, before the command
            break
    child.send_signal(signal.SIGINT)
    assert "Traceback" not in child.stderr.read()
    assert child.wait(timeout=60) in (-signal.SIGINT, 130)


# ------------------------------------------------------------------------------------------- hints


@pytest.mark.parametrize(
    "argv,module,expected",
    [
        ("/usr/bin/sofnn-train", None, "sofnn-train"),
        ("my code/train.py", None, "python3 'my code/train.py'"),
        ("x", "sofnn_torch.cli", "python3 -m sofnn_torch.cli"),
        ("x", "sofnn_torch.rules.__main__", "python3 -m sofnn_torch.rules"),
    ],
)
def test_a_program_is_named_as_it_was_called(argv, module, expected, monkeypatch):
    spec = module and SimpleNamespace(name=module)
    monkeypatch.setitem(sys.modules, "__main__", SimpleNamespace(__spec__=spec))
    monkeypatch.setattr(sys, "argv", [argv])
    monkeypatch.setattr(sys, "orig_argv", ["python3", argv])
    assert terminal.program() == expected
    others = "sofnn-evaluate" if argv.endswith("sofnn-train") else "python3 -m sofnn_torch.evaluate"
    assert terminal.program("evaluate") == others


def test_a_training_is_named_by_what_there_is_to_call(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "orig_argv", ["python3", "x"])
    monkeypatch.setattr(sys, "argv", ["x"])
    monkeypatch.chdir(tmp_path)
    assert terminal.program("train") == "python3 -m sofnn_torch.cli"
    (tmp_path / "train.py").touch()
    assert terminal.program("train") == "python3 train.py"


@pytest.mark.parametrize("runs,name", [("my runs", "one run"), ("-odd", "it's")])
def test_the_hint_after_a_stop_can_be_pasted(runs, name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    real = training.play

    def play(*arguments, **keywords):
        os.kill(os.getpid(), signal.SIGUSR1)
        return real(*arguments, **keywords)

    monkeypatch.setattr(training, "play", play)
    place = f"./{runs}"
    assert cli.main([*QUICK, "--runs", place, "--name", name, "--quiet"]) == 128 + signal.SIGUSR1
    hint = capsys.readouterr().err.partition("go on with: ")[2]
    monkeypatch.setattr(training, "play", real)
    words = shlex.split(hint)
    assert cli.main([*words[words.index("--resume") :], "--quiet"]) == 0
    assert checkpoint.find_latest(Path(place, name))[1]["trial"] == 2


def test_the_end_of_a_training_says_what_was_reached_and_what_comes_next(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    words = ["--trials=12", "--runs=my runs", "--picture-every=0", "--video-every=0"]
    assert cli.main([*words, "--maze.max-steps=100", "--name=a"]) == 0
    done, reached, following, *commands = capsys.readouterr().out.splitlines()
    state = checkpoint.find_latest(Path("my runs/a"))[1]
    assert done == "my runs/a: done" and following == "next:"
    assert reached == f"goal in 0 of the last 10 trials; {state['network']['rules']} rules"
    ends = [shlex.split(command)[-2:] for command in commands]
    assert [end[1] for end in ends] == ["my runs/a", "my runs/a", "my runs"]
    assert [end[0] for end in ends] == ["sofnn_torch.evaluate", "sofnn_torch.rules", "--logdir"]


@pytest.mark.parametrize("words", ["--name --quiet", "--name=-x", "--name=--x", "--runs=--x"])
def test_names_that_look_like_flags_are_refused(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main([*words.split(), "--trials=1"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.match(r"error: --(name|runs) (needs a value|must be a plain directory name)", line)
    assert not list(tmp_path.iterdir())


def test_a_name_from_python_that_looks_like_a_flag_is_refused(tmp_path):
    with pytest.raises(ValueError, match="--name must be a plain directory name, got '-x'"):
        quick_options(tmp_path, name="-x")


def test_other_streams_stay_as_they_are(monkeypatch):
    notebook = io.StringIO()
    monkeypatch.setattr(sys, "stdout", notebook)
    with streams.output():
        assert sys.stdout is notebook
