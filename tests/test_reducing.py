"""Few rules that do what many did: known policies, the learners' own decisions, and the command."""

import dataclasses
import json
import math
import shutil

import numpy as np
import pytest
import torch
from conftest import contents, parameters, quick_options, written
from exported import FEW, learner

from sofnn_torch import SGA, SOFNN, SGAConfig, Task, evaluate, training
from sofnn_torch.network.axes import Axis
from sofnn_torch.rules import reducing
from sofnn_torch.rules.fitting import Fit
from sofnn_torch.runs import seeding
from sofnn_torch.runs.directory import load_config
from sofnn_torch.runs.factory import make_agent, make_env
from sofnn_torch.runs.settings import Config

ACTIONS = ("right", "left")


def deciding(axis, centres, width, left):
    """A learner on one axis with a rule at each centre, and the actions that these conclude."""
    net = SOFNN((axis,), 3, width=width)
    for centre in centres:
        net.add_rule(torch.tensor([centre]))
    mu = torch.where(torch.from_numpy(left(centres)), 0.8, -0.8).float()
    rows = torch.stack([mu, torch.full_like(mu, 0.1), torch.zeros_like(mu)], 1)
    net.replace_rules(net.centres, net.widths, rows)
    return SGA(net, Task((axis,), ACTIONS, discrete=True), SGAConfig())


def smaller(agent, states, count, steps=150):
    """A learner with a few rules that were fitted to another one's decisions at states (B, n)."""
    fit = Fit(agent, states, count, seed=0)
    fit.improve(states, steps)
    net = SOFNN(agent.inputs, agent.net.n_outputs, width=agent.net.default_width.tolist())
    net.replace_rules(*fit.found())
    return SGA(net, agent.task, agent.settings)


# ------------------------------------------------------------------------- what is fitted


def test_two_rules_switch_where_sixty_did():
    agent = deciding(Axis("x", "m", 0, 1), np.linspace(0, 1, 60), 0.02, lambda x: x > 0.3)
    x = np.linspace(0, 1, 401, dtype=np.float32)
    small = smaller(agent, x[:, None], 2)
    away = abs(x - 0.3) > 0.015  # sixty rules of width 0.02 know the place no better
    left = small.plan(x[:, None]).choice == 1
    assert small.net.n_rules == 2 and np.array_equal(left[away], x[away] > 0.3)
    # Each of the two concludes by itself what is done where it is centred.
    assert np.array_equal(small.net.consequents[:, 0] > 0, small.net.centres[:, 0] > 0.3)


def test_rules_of_a_heading_reach_over_its_seam():
    axis = Axis("heading", "rad", period=2 * math.pi)
    angles = np.linspace(-math.pi, math.pi, 14, endpoint=False)
    agent = deciding(axis, angles, 0.45, lambda angle: np.cos(angle) > 0)
    x = np.linspace(-math.pi, math.pi, 720, dtype=np.float32)
    small = smaller(agent, x[:, None], 2)
    away = abs(np.cos(x)) > 0.05
    left = small.plan(x[:, None]).choice == 1
    assert np.array_equal(left[away], np.cos(x[away]) > 0)
    assert (small.net.centres.abs() <= math.pi).all()


def test_a_policy_of_numbers_is_followed():
    config, agent = learner("pendulum", rules=6)
    states = np.random.default_rng(1).uniform(-1, 1, (400, 3)).astype(np.float32)
    fit = Fit(agent, states, 5, seed=0)
    wanted = agent.plan(states).actions

    def error():
        small = make_agent(config)
        small.net.replace_rules(*fit.found())
        return np.abs(small.plan(states).actions - wanted).mean()

    before = error()
    fit.improve(states, 150)
    assert error() < before / 2


def inside(agent, count, seed):
    """States by chance in the range of a learner's axes."""
    axes = agent.task.axes
    low, high = (np.array([getattr(axis, end) for axis in axes]) for end in ("low", "high"))
    chance = np.random.default_rng(seed)
    return chance.uniform(low, high, (count, len(axes))).astype(np.float32)


@pytest.mark.parametrize("kind", FEW)
def test_the_fit_knows_what_the_learner_would_do(kind):
    _, agent = learner(kind)
    states = inside(agent, 200, seed=2)
    fit = Fit(agent, states, 12, seed=0)
    x = torch.from_numpy(states)
    scores = fit.scores(x, fit.outputs(x)).numpy()
    plan = agent.plan(states)
    if agent.choices:
        assert np.array_equal(scores.argmax(1), plan.choice)
    else:
        wanted = plan.actions.reshape(len(states), -1)
        assert np.abs(np.clip(scores, -1, 1) - wanted).max() < 1e-6


@pytest.mark.parametrize("kind", FEW)
def test_rules_that_are_found_are_rules_that_the_learner_may_have(kind):
    config, agent = learner(kind)
    states = inside(agent, 300, seed=3)
    fit = Fit(agent, states, 9, seed=0)
    fit.improve(states, 30)
    small = make_agent(config)
    small.net.replace_rules(*fit.found())
    full, few = agent.net.consequents, small.net.consequents
    room = 1e-5 * full.abs().amax()
    assert ((few >= full.amin(0) - room) & (few <= full.amax(0) + room)).all()
    assert (small.net.widths >= small.net.min_width).all() and small.net.n_rules == 9
    with torch.no_grad():  # the network computes what was fitted
        x = torch.from_numpy(states)
        expected = fit.outputs(x, fit.rules())
        inputs = small.network_inputs(x).reshape(-1, len(agent.inputs))
        torch.testing.assert_close(
            small.net(inputs).reshape(expected.shape), expected, rtol=1e-4, atol=1e-4
        )


# ------------------------------------------------------------------------- what is played


def test_trials_are_those_of_evaluate_without_its_way_out():
    config, agent = learner("three", steps=200)
    records = evaluate.evaluate(config, agent, 3, seed=7, plain=True)
    env = make_env(config)
    seeding.begin(env, agent, 7)
    visit = reducing.visit(env, agent, 3)
    assert visit.steps == [record.steps for record in records]
    assert [len(states) for states in visit.states] == [record.decisions for record in records]
    assert visit.outcomes == [record.outcome for record in records]


def test_long_trials_are_cut_and_their_states_are_kept():
    config, agent = learner("three", steps=400)
    visit = reducing.visit(make_env(config), agent, 2, most=5)
    assert [states.shape for states in visit.states] == [(5, 3), (5, 3)]


def visited(outcomes, steps, goals=True):
    states = [np.full((2, 3), i, np.float32) for i in range(len(outcomes))]
    return reducing.Visit(states, goals, outcomes, steps)


def test_goals_count_before_steps_and_return_alone_where_there_is_no_goal():
    full = visited([1.0, 1.0, 0.0], [500, 500, 20_000])
    assert visited([1.0, 1.0], [900, 900]).worth > visited([1.0, 0.0], [400, 400]).worth
    assert visited([1.0, 1.0], [510, 520]).loss(full) == pytest.approx(0.03)
    assert visited([1.0, 0.0], [400, 400]).loss(full) == 1
    pole = visited([500.0, 500.0], [500, 500], goals=False)
    assert visited([495.0, 500.0], [495, 500], goals=False).loss(pole) == pytest.approx(0.005)
    car = visited([-100.0, -100.0], [100, 100], goals=False)
    assert visited([-110.0, -100.0], [110, 100], goals=False).loss(car) == pytest.approx(0.05)


def test_trials_that_miss_the_goal_show_no_way():
    assert [way[0, 0] for way in visited([1.0, 0.0, 1.0], [500, 9000, 500]).ways] == [0, 2]
    assert len(visited([0.0, 0.0], [9000, 9000]).ways) == 2
    assert len(visited([0.0, -5.0], [9, 9], goals=False).ways) == 2


@pytest.mark.parametrize("kind", ["three", "wheels"])
def test_agreement_is_counted_decision_by_decision(kind):
    _, one = learner(kind, seed=0)
    _, other = learner(kind, seed=1)
    states = np.random.default_rng(4).uniform(0, 1, (50, 3)).astype(np.float32)
    pairs = [(one.act(state), other.act(state)) for state in states]
    limit = 0 if kind == "three" else reducing.CLOSE
    same = [np.abs(np.subtract(a, b)).max() <= limit for a, b in pairs]
    assert reducing.agreement(one, other, states) == pytest.approx(np.mean(same))
    assert reducing.agreement(one, one, states) == 1


# ---------------------------------------------------------------------------- the command


@pytest.fixture
def hurried(monkeypatch):
    """So few trials and steps that a command takes a second."""
    for name, value in {
        "ROUNDS": 1,
        "MOST": 1,
        "STEPS": 5,
        "TRIALS": 2,
        "DECIDING": 1,
    }.items():
        monkeypatch.setattr(reducing, name, value)


@pytest.fixture(scope="module")
def pole(tmp_path_factory):
    """A run of two trials with a pole, which are short. Leave it as it is."""
    config, _ = learner("pole q")
    config = dataclasses.replace(config, trials=2)
    return training.train(config, quick_options(tmp_path_factory.mktemp("pole"), name="run"))


@pytest.fixture
def run(pole, tmp_path):
    return shutil.copytree(pole, tmp_path / "runs" / "run")


def test_small_rule_bases_become_runs_that_every_command_takes(run, call, hurried):
    before, full = contents(run), evaluate.load(run).agent.net.n_rules
    before_config = load_config(run)
    code, text, _ = call(run, "--reduce", 3, 2)
    assert code == 0 and contents(run) == before
    made = [run.with_name(f"run-{count}-rules") for count in (3, 2)]
    for path, count in zip(made, (3, 2), strict=True):
        assert f"{path}: {count} rules instead of {full}" in text.splitlines()
        config, agent, _, state = evaluate.load(path)
        assert agent.net.n_rules == count and state["trial"] == 2
        assert config.net.growth == "frozen"  # they stay as they are
        assert (config.q.replays, config.q.replay_every) == (0, 0)
        assert dataclasses.replace(config, rules="", net=before_config.net, q=before_config.q) == (
            dataclasses.replace(before_config, sga=config.sga)
        )
        (record,) = evaluate.evaluate(config, agent, 1)
        assert record.decisions > 0
    earlier = json.loads((made[0] / "config.json").read_text())["earlier"]
    source = str(run / "checkpoint-2.pt")
    assert earlier[-1]["reduced"] == {"checkpoint": source, "rules": 3, "seed": 1000}
    assert call(made[0], "--top", 0)[0] == 0
    training.resume(made[1], quick_options(run.parent), trials=3)
    learned_on = evaluate.load(made[1])
    assert learned_on.state["trial"] == 3 and learned_on.agent.net.n_rules == 2


def test_equal_seeds_give_equal_rules_and_others_do_not(pole, hurried):
    tables = []
    for seed in (0, 0, 1):
        config, agent, _, _ = evaluate.load(pole)
        tables.append(parameters(reducing.reduced(config, agent, 3, seed)))
    assert np.array_equal(tables[0], tables[1])
    assert not np.array_equal(tables[0], tables[2])


def test_rules_that_a_run_was_given_become_fewer_and_stay_given(tmp_path, call, hurried):
    config, agent = learner("pole q", rules=8)
    file = written(agent, tmp_path / "eight.csv")
    config = dataclasses.replace(config, rules=file.read_text(), trials=1)
    run = training.train(config, quick_options(tmp_path, name="run"))
    assert call(run, "--reduce", 3, "--name", "three")[0] == 0
    small = evaluate.load(tmp_path / "three")
    assert small.agent.net.n_rules == small.agent.net.given == 3
    assert np.array_equal(parameters(make_agent(small.config)), parameters(small.agent))


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--reduce", 0), "--reduce"),
        (("--reduce", 100_000), "fewer than there are"),
        (("--reduce", 3, 2, "--name", "x"), "--name goes with --load, or with --reduce and one"),
        (("--reduce", 3, "--check"), "do not go together"),
        (("--reduce", 3, "--name", "run"), "is there already"),
    ],
)
def test_what_cannot_be_is_one_line(run, call, hurried, flags, said):
    before = contents(run.parent)
    code, _, error = call(run, *flags)
    assert code == 2 and said in error and "Traceback" not in error
    assert contents(run.parent) == before


def test_a_grid_and_a_learner_without_decoding_are_refused(monkeypatch):
    config, agent = learner("three", rules=10)
    states = np.zeros((9, 3), np.float32)
    monkeypatch.setattr(type(agent), "decoding", lambda self: (_ for _ in ()).throw(ValueError))
    with pytest.raises(ValueError, match="does not say how outputs become actions"):
        Fit(agent, states, 2, seed=0)
    fixed = dataclasses.replace(config, network="fixed")
    with pytest.raises(ValueError, match="a fixed one keeps its rules"):
        reducing.reduced(fixed, make_agent(fixed), 2)


def test_a_policy_that_misses_the_goal_is_refused():
    config, agent = learner("three", steps=60)
    with pytest.raises(ValueError, match="reaches the goal in none of 10 trials: train on"):
        reducing.reduced(config, agent, 2)


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["sga", "q"])
def test_twenty_rules_drive_as_well_as_all_of_a_learned_policy(agent, tmp_path):
    config = Config(agent=agent, seed=3, trials=80)
    run = training.train(config, quick_options(tmp_path, checkpoint_every=80))
    full = evaluate.load(run).agent
    small = reducing.reduced(config, full, 20, seed=0)
    many, few = (evaluate.evaluate(config, each, 20, seed=9) for each in (full, small))
    assert small.net.n_rules == 20 < full.net.n_rules / 10
    assert all(record.success for record in few)
    steps = [np.mean([record.steps for record in records]) for records in (many, few)]
    assert steps[1] < 1.1 * steps[0]
