"""A policy without torch decides as the learner does, and its file is read or refused."""

import dataclasses
import json
import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from exported import ALL, KINDS, learner, states
from own import Sarsa, SarsaConfig

from sofnn_torch.export import __main__ as export
from sofnn_torch.export import policy, runtime
from sofnn_torch.learners.frozen import FrozenPolicy
from sofnn_torch.learners.learner import Task
from sofnn_torch.network.axes import named
from sofnn_torch.network.sofnn import SOFNN
from sofnn_torch.runs.factory import make_env
from sofnn_torch.runs.seeding import begin, stream
from sofnn_torch.training import play


@pytest.fixture(params=KINDS)
def kind(request):
    """Every kind of policy."""
    return request.param


def exported(config, agent, **options):
    """The policy of a learner, through its file's text."""
    data = json.loads(policy.to_json(policy.describe(config, agent)))
    return runtime.Policy(data, **options)


def test_at_many_states_outputs_are_equal_and_decisions_but_where_two_are_as_good(kind):
    config, agent = learner(kind)
    ours, x = exported(config, agent), states(agent, 1000)
    seen = ours.state(x).astype(np.float32)
    with torch.no_grad():
        inputs = agent.network_inputs(torch.from_numpy(seen)).double()
        expected = agent.net.double()(inputs.reshape(-1, inputs.shape[-1])).numpy()
    found = ours.outputs(x)
    np.testing.assert_allclose(found.reshape(expected.shape), expected, atol=2e-5)
    agent.net.float()
    plan = agent.plan(seen)
    actions = np.array([ours.act(state) for state in x])
    if not agent.task.discrete:
        close = np.abs(actions - plan.actions).max(1) < 1e-5
    else:
        close = actions == plan.actions
    undecided = margins(ours, x) < 1e-5
    assert (close | undecided).all() and undecided.mean() < 0.01


def margins(ours, x):
    """How far each state is from another decision."""
    if ours.decision["kind"] == "values":
        best = np.sort(ours.values(x), -1)
        return best[:, -1] - best[:, -2]
    edges = ours.decision["edges"]
    if edges is None:
        return np.ones(len(x))
    return np.abs(ours.outputs(x)[:, :1] - np.array(edges)).min(1)


@pytest.mark.parametrize("kind", ALL)
def test_whole_trials_are_those_of_the_evaluation_the_way_out_of_loops_included(kind):
    config, agent = learner(kind, rules=12, steps=600)
    if math.isfinite(agent.task.patience):  # sooner, in so short a trial
        agent.task = dataclasses.replace(agent.task, patience=3)
    explore = kind in ("steer", "q", "pole q")
    ours = exported(config, agent, seed=stream("policy", 7), explore=explore)
    env = make_env(config)
    begin(env, agent, 7)
    inner, commands = getattr(env, "env", None), 0
    freed = 0
    for _ in range(2):
        frozen, (x, _) = FrozenPolicy(agent, explore), env.reset()
        action, done = ours.start(x), False
        np.testing.assert_allclose(action, frozen.start(x), atol=1e-4)
        while not done:
            if inner is not None:
                assert inner.action_space.contains(ours.command(action))
                np.testing.assert_array_equal(ours.command(action), env.translation.action(action))
            else:
                np.testing.assert_allclose(ours.command(action), env.wheel_speeds(action))
            commands += 1
            x, _, ended, cut, _ = env.step(action)
            done = ended or cut
            if not done:
                action = ours.step(x)
                np.testing.assert_allclose(action, frozen.step(0.0, x, False), atol=1e-4)
        freed += frozen.freed
    env.close()
    assert commands > 15 and (freed > 0) == (inner is None), freed


def test_a_trial_alone_takes_as_many_steps_as_in_the_evaluation():
    config, agent = learner("three", rules=12, steps=2000)
    env = make_env(config)
    begin(env, agent, 3)
    record, path = play(env, agent, learn=False, explore=False)
    ours = exported(config, agent, seed=stream("policy", 3))
    begin(env, agent, 3)
    x, info = env.reset()
    action, places = ours.start(x), [info["estimated_pose"]]
    while action is not None:
        x, _, ended, cut, info = env.step(action)
        places.append(info["estimated_pose"])
        action = None if ended or cut else ours.step(x)
    assert info["total_steps"] == record.steps
    np.testing.assert_array_equal(places, path.estimated)


# --------------------------------------------------------------------------------------- files


@pytest.fixture
def file(tmp_path):
    """A policy on the disk, with the runtime beside it."""
    path = tmp_path / "policy.json"
    path.write_bytes(policy.to_json(policy.describe(*learner("three", rules=5))))
    (tmp_path / policy.RUNTIME).write_bytes(policy.runtime_source())
    return path


@pytest.fixture
def command(monkeypatch, capsys):
    """Calls the command: its exit code, output and error stream."""

    def call(*arguments):
        monkeypatch.setattr("sys.argv", ["export", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            export.main()
        return stop.value.code, *capsys.readouterr()

    return call


def alone(file, lines, *arguments):
    """Runs the copied runtime where nothing of this package can be imported."""
    call = [sys.executable, "-I", file.parent / policy.RUNTIME, file, *arguments]
    return subprocess.run(call, input=lines, capture_output=True, text=True)


def test_the_copied_file_needs_numpy_alone_and_answers_lines(file):
    done = alone(file, "0.5 0.5 0\n0.5,0.5,0.1\n\n0.5 0.5 0\n", "3")
    expected = runtime.read(file, seed=3)
    states = [[0.5, 0.5, 0.0], [0.5, 0.5, 0.1], [0.5, 0.5, 0.0]]
    decisions = [expected.start(states[0]), expected.step(states[1]), expected.start(states[2])]
    answers = [[float(word) for word in line.split()] for line in done.stdout.splitlines()]
    assert answers == [expected.command(action).tolist() for action in decisions]
    source = policy.runtime_source().decode()
    assert len(source.splitlines()) <= 300
    assert "torch" not in {line.split()[1] for line in source.splitlines() if "import " in line[:7]}


def test_what_is_written_can_be_read_and_written_again(file, command):
    again = file.with_name("again.json")
    code, out, _ = command(file, "--to", again)
    assert code == 0 and "5 rules" in out and "sofnn_runtime.py" in out
    assert again.read_bytes() == file.read_bytes()


def cut(text):
    return text[: len(text) // 2]


def without(name):
    return lambda text: json.dumps({k: v for k, v in json.loads(text).items() if k != name})


def changed(*path, to):
    def change(text):
        data = json.loads(text)
        place = data
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = to
        return json.dumps(data)

    return change


SPOILT = {
    "truncated": (cut, "not JSON, or not all of it"),
    "empty": (lambda _: "", "not JSON"),
    "another file": (lambda _: "[1, 2]", "not a policy"),
    "a newer version": (changed("version", to=2), "version 2"),
    "no rules": (changed("rules", to=[]), "at least one input and one rule"),
    "a short rule": (
        changed("rules", 1, "centre", to=[1, 2]),
        "rule 2, centre: must be a list of 3",
    ),
    "a NaN": (changed("rules", 0, "consequents", to=[float("nan"), 1, 1]), "rule 1, consequents"),
    "no width": (changed("rules", 4, "width", to=[1, 0, 1]), "rule 5, width: must be positive"),
    "text": (changed("rules", 0, "width", to=["1", 1, 1]), "rule 1, width"),
    "no decision": (without("decision"), "decision must be of type dict"),
    "another decision": (changed("decision", "kind", to="dice"), "not a policy"),
    "no edges": (
        changed("decision", to={"kind": "normal", "numbers": 1}),
        "not a policy: KeyError",
    ),
    "no command": (changed("command", to={}), "not a policy: KeyError('kind')"),
    "wrong axes": (changed("axes", 0, to=3), "not a policy"),
}


@pytest.mark.parametrize(("spoil", "said"), SPOILT.values(), ids=SPOILT.keys())
def test_a_spoilt_file_is_one_line(file, command, spoil, said):
    file.write_text(spoil(file.read_text()))
    code, _, error = command(file, "--to", file.with_name("new.json"))
    assert code == 2 and error.count("\n") == 1 and said in error and str(file) in error
    done = alone(file, "0 0 0\n")
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and said in done.stderr


def test_wrong_flags_are_one_line(file, command, tmp_path):
    for arguments, said in (
        ([file], "--to is missing"),
        ([file, "--to", tmp_path / "x.doc"], "--to must end in"),
        ([file, "--to", tmp_path / "none" / "x.json"], "not a file in an existing directory"),
        ([file, "--best", "--to", tmp_path / "x.json"], "--best chooses a checkpoint"),
        ([tmp_path / "none.json", "--to", tmp_path / "x.json"], "cannot be read"),
        ([tmp_path, "--to", tmp_path / "x.json"], "config.json"),
    ):
        code, _, error = command(*arguments)
        assert code == 2 and error.count("\n") == 1 and said in error, arguments


def test_a_learner_that_says_no_decoding_is_refused_in_one_line():
    task = Task(named(2), ("left", "right"), discrete=True)
    agent = Sarsa(SOFNN(2, 2, width=0.2), task, SarsaConfig())
    with pytest.raises(ValueError, match="sarsa cannot be exported"):
        agent.decoding()


def test_an_observation_of_another_length_is_one_line(file):
    done = alone(file, "0 0\n")
    assert "an observation of 3 numbers is needed" in done.stderr and done.stderr.endswith("\n")
