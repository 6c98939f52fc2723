"""Any Gymnasium task: axes, actions, seeds and scales, and a run of each kind from end to end."""

import dataclasses
import json
import sys
import types

import gymnasium
import numpy as np
import pytest
from conftest import quick_options
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple

from sofnn_torch import evaluate, training
from sofnn_torch.cli import main
from sofnn_torch.network.axes import Axis
from sofnn_torch.pictures.film import film
from sofnn_torch.rules import words
from sofnn_torch.rules.__main__ import main as rules_main
from sofnn_torch.runs.session import build
from sofnn_torch.runs.settings import Config, from_dict
from sofnn_torch.tasks import survey
from sofnn_torch.tasks.env import TaskEnv, look, make, versioned

CLASSIC = ["MountainCar-v0", "MountainCarContinuous-v0", "CartPole-v1", "Acrobot-v1", "Pendulum-v1"]
UNIT = Box(-1, 1, (2,))


class Toy(gymnasium.Env):
    """Shows what it was given: the observation is a random number of the trial and a count."""

    def __init__(self, observations=UNIT, actions=None, reward=1.0, success=None, steps=3):
        self.observation_space = observations
        self.action_space = actions or Discrete(2)
        self.reward, self.success, self.steps = reward, success, steps
        self.taken = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.taken = []
        return self._observe(), {}

    def step(self, action):
        self.taken.append(action)
        info = {} if self.success is None else {"is_success": np.bool_(self.success)}
        return self._observe(), self.reward, len(self.taken) == self.steps, False, info

    def _observe(self):
        numbers = np.full(self.observation_space.shape, self.np_random.uniform(-9, 9))
        return numbers.astype(self.observation_space.dtype)


@pytest.fixture
def toy():
    """Registers an environment that `Toy` describes; gives its id."""
    made = []

    def register(**options):
        name = f"Toy{len(made)}{abs(hash(str(options)))}-v0"
        gymnasium.register(name, entry_point=lambda **_: Toy(**options))
        made.append(name)
        return name

    yield register
    for name in made:
        del gymnasium.registry[name]


def short(env, agent="sga", network="sofnn", **parts):
    """Settings of a run of a second: few rules, few batches."""
    config = Config(env=env, agent=agent, network=network, trials=2)
    parts = {"net": {"max_rules": 200}, agent: {"replays": 1}} | parts
    if network == "fixed":
        parts["net"] = {"grid": (2,)}
    changes = {k: dataclasses.replace(getattr(config, k), **v) for k, v in parts.items()}
    return dataclasses.replace(config, **changes)


# ------------------------------------------------------------------------------- the environment


@pytest.mark.parametrize("name", CLASSIC)
def test_known_tasks_have_named_axes_with_ends(name):
    found = look(name)
    assert all(axis.bounded for axis in found.axes)
    assert not any(axis.name.startswith("obs") for axis in found.axes)
    inner = gymnasium.make(name)
    assert len(found.axes) == inner.observation_space.shape[0]
    for axis, low, high in zip(
        found.axes, inner.observation_space.low, inner.observation_space.high, strict=True
    ):
        assert low <= axis.low + 1e-6 and axis.high - 1e-6 <= high


@pytest.mark.parametrize("name", CLASSIC)
def test_actions_reach_the_ends_of_their_range(name):
    env = make(name)
    inner = env.env.action_space
    if isinstance(inner, Discrete):
        taken = [env.translation.action(action) for action in range(len(env.action_names))]
        assert taken == list(range(inner.start, inner.start + inner.n))
    else:
        low, high = (env.translation.action(np.full(inner.shape, end)) for end in (-1.0, 1.0))
        assert (low == inner.low).all() and (high == inner.high).all()
        assert inner.contains(low) and inner.contains(high)


def test_each_number_of_an_action_has_a_range_of_its_own():
    inner = Box(np.array([[-2.0, 0.0]]), np.array([[2.0, 10.0]]), dtype=np.float64)
    env = TaskEnv(Toy(actions=inner))
    assert env.action_space == Box(-1, 1, (2,))
    action = env.translation.action(np.float32([0.5, -0.5]))
    np.testing.assert_array_equal(action, [[1.0, 2.5]])
    assert inner.contains(action)


def test_discrete_actions_count_from_the_start_of_their_space():
    env = TaskEnv(Toy(actions=Discrete(3, start=-1)))
    env.reset(seed=0)
    for action in range(3):
        env.step(action)
    assert env.env.taken == [-1, 0, 1]


def test_observations_are_flat_float32_and_end_where_their_axes_end():
    env = TaskEnv(
        Toy(observations=Box(-9, 9, (2, 2), np.float64)), [Axis(c, "", -1, 1) for c in "abcd"]
    )
    seen = [env.reset(seed=seed)[0] for seed in range(20)]
    assert {x.shape for x in seen} == {(4,)} and {x.dtype for x in seen} == {np.dtype(np.float32)}
    assert np.abs(seen).max() == 1.0 and np.isnan(env.translation.states([np.nan] * 4)).all()


def test_an_axis_that_wraps_has_no_ends_to_stop_at():
    env = TaskEnv(Toy(), [Axis("a", "rad", -1, 1, period=2), Axis("b", "", -1, 1)])
    assert env.translation.states([5.0, 5.0]).tolist() == [5.0, 1.0]


def test_each_trial_has_a_seed_of_its_own():
    one, other = (TaskEnv(Toy()) for _ in range(2))
    one.reset(seed=3)
    trials = [one.reset()[0][0] for _ in range(4)]
    assert len(set(trials)) > 1
    other.load_state_dict({"seed": 3, "trial": 2})
    assert [other.reset()[0][0] for _ in range(2)] == trials[2:]


def test_a_trial_without_a_limit_ends(monkeypatch):
    monkeypatch.setattr("sofnn_torch.tasks.env.LONGEST", 5)
    env = TaskEnv(Toy(steps=10**9))
    env.reset(seed=0)
    assert [env.step(0)[3] for _ in range(5)] == [False] * 4 + [True]


@pytest.mark.parametrize(
    ("spaces", "said"),
    [
        ({"observations": Dict(a=UNIT)}, "observations must be a Box of numbers, not Dict"),
        ({"observations": Tuple([UNIT])}, "not Tuple"),
        ({"observations": Discrete(4)}, "not Discrete"),
        ({"observations": Box(0, 255, (8, 8, 3), np.uint8)}, "reduce pictures to a few features"),
        ({"observations": Box(-1, 1, (65,))}, "1 to 64"),
        ({"actions": MultiDiscrete([2, 3])}, "actions must be Discrete or a Box"),
        ({"actions": MultiBinary(3)}, "actions must be Discrete or a Box"),
        ({"actions": Box(-np.inf, np.inf, (1,))}, "bound them first"),
        ({"actions": Discrete(1001)}, "at most 1000"),
    ],
)
def test_what_is_not_supported_is_one_line(spaces, said, toy, tmp_path, capsys):
    assert main(["--env", toy(**spaces), "--runs", str(tmp_path / "runs")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: --env ") and said in line
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("--env MountainCarr-v0", "did you mean MountainCar-v0?"),
        ("--env nowhere_at_all:X-v0", "No module named 'nowhere_at_all'"),
        (
            "--env MountainCar-v0 --maze.hold 3",
            "--maze.hold has no effect with --env MountainCar-v0",
        ),
        ("--env MountainCar-v0 --pose true", "--pose has no effect with --env MountainCar-v0"),
        ("--env MountainCar-v0 --net.width-heading 1", "--net.width-heading has no effect"),
        ("--env MountainCar-v0 --agent q --q.segments 9", "--q.segments has no effect"),
        ("--env MountainCar-v0 --agent q --q.points", "--q.points has no effect"),
        ("--net.width 0.3", "--net.width has no effect with --env maze"),
        ("--axes a m 0 1 0", "--axes has no effect with --env maze"),
        ("--reward-scale 2", "--reward-scale has no effect with --env maze"),
        (
            "--env MountainCar-v0 --axes a m 0 1 0",
            "must name all 2 inputs of MountainCar-v0, got 1",
        ),
        ("--env MountainCar-v0 --axes a m 0 1 0 b m 1 0 0", "axis b: low must be under high"),
        ("--env MountainCar-v0 --axes a m 0 1 0 a m 0 1 0", "a name of its own"),
        (
            "--env MountainCar-v0 --net.width 0.3 0.3 0.3",
            "--net.width needs 2 values or one, got 3",
        ),
        (
            "--env MountainCar-v0 --network fixed --net.grid 3 3 3",
            "--net.grid needs 2 values or one",
        ),
        ("--env MountainCar-v0 --preset paper", "--preset paper is for --env maze"),
        ("--env Reacher-v5 --agent q", "use SGA"),
        (
            "--env MountainCar-v0 --axes a m 0 1",
            "--axes must be NAME UNIT LOW HIGH PERIOD ..., got 'a m 0 1'",
        ),
        ("--env Pendulum-v1 --agent q --q.coding wheels", "for a robot with two wheels"),
    ],
)
def test_flags_that_do_not_go_together_are_one_line(flags, said, tmp_path, capsys):
    assert main([*flags.split(), "--runs", str(tmp_path / "runs")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert not (tmp_path / "runs").exists()


def test_q_learning_refuses_more_than_one_number_as_action(toy):
    with pytest.raises(ValueError, match="use SGA"):
        Config(env=toy(actions=UNIT), agent="q")


def test_an_id_may_name_the_module_that_registers_it(monkeypatch):
    module = types.ModuleType("my_tasks")
    monkeypatch.setitem(sys.modules, "my_tasks", module)
    gymnasium.register("Mine-v0", entry_point=lambda **_: Toy())
    assert [axis.name for axis in Config(env="my_tasks:Mine-v0").task.axes] == ["obs 1", "obs 2"]
    del gymnasium.registry["Mine-v0"]


def test_an_id_without_a_version_is_that_of_the_newest():
    assert Config(env="CartPole").env == Config(env="CartPole-v1").env == "CartPole-v1"
    assert versioned("gymnasium:Pendulum") == "gymnasium:Pendulum-v1"
    assert versioned("CartPole-v0") == "CartPole-v0"
    assert versioned("Nothing") == "Nothing"
    assert versioned("no_module:CartPole") == "no_module:CartPole"


@pytest.mark.filterwarnings("default")
def test_what_a_library_warns_of_is_a_line(tmp_path, capsys):
    assert main(["--env", "CartPole-v0", "--trials", "1", "--runs", str(tmp_path)]) == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "out of date" in line]
    assert line.startswith("warning: The environment CartPole-v0 is out of date")


# -------------------------------------------------------------------------------- random play


def test_missing_ends_are_those_of_random_play_with_a_margin():
    axis = survey.within(Axis("speed", "m/s", -1.0), -0.5, 3.5)
    assert (axis.low, axis.high) == (-1.0, 3.5 + 0.25 * 4)
    still = survey.within(Axis("still"), 2.0, 2.0)
    assert still.low < 2 < still.high
    with pytest.raises(ValueError, match="--axes"):
        survey.within(Axis("lost"), 0.0, np.inf)


def test_rewards_are_scaled_so_that_values_are_about_one():
    assert survey.scale([[-1.0] * 200]) == 0.01  # -1 for ever is worth 1 / (1 - 0.99)
    assert survey.scale([[0.0] * 99 + [-500.0]]) == 0.002  # at the end it is worth 500
    assert survey.scale([[0.0, 0.001]]) == survey.scale([[0.0], []]) == 1.0


def test_an_unknown_state_is_worth_nothing_only_where_every_step_costs():
    rng = np.random.default_rng(0)
    effort = [(-0.1 * rng.uniform(-1, 1, 999) ** 2).tolist()]  # idling is free
    for trials, initial in [
        ([[-1.0] * 200], 0.0),
        ([[-1.0] * 80 + [0.0], [-1.0] * 90 + [0.0]], 0.0),
        ([[1.0] * 20], 1.0),
        ([[0.0] * 50], 1.0),
        (effort, 1.0),
    ]:
        assert survey.optimism(trials)["initial"] == initial


def test_unknown_tasks_are_learned_with_what_random_play_said(toy):
    assert Config(env=toy(reward=-4.0), agent="q").q.initial == 0.0
    assert Config(env=toy(reward=4.0), agent="q").q.initial == 1.0
    assert Config(env="CartPole-v1", agent="q").q.value_limit == 1.0


def test_what_random_play_found_is_saved_with_the_run(toy, tmp_path):
    env = toy(observations=Box(-np.inf, np.inf, (2,)), reward=-4.0)
    config = short(env)
    assert config.reward_scale == 0.0025 and all(-15 < low < -5 for _, _, low, *_ in config.axes)
    run = training.train(config, quick_options(tmp_path))
    survey.survey.cache_clear()
    loaded = evaluate.load(run)
    assert loaded.config == config
    assert loaded.agent.task.axes == config.task.axes
    assert Config(env=env, seed=1).axes != config.axes


def test_inputs_can_be_renamed_and_bounded():
    config = Config(env="CartPole-v1", axes=[[c, "u", -1, 1, 2.0] for c in "abcd"])
    assert config.task.axes[3] == Axis("d", "u", -1, 1, 2.0)
    assert from_dict(json.loads(config.to_json())) == config


def test_widths_are_shares_of_the_range():
    config = short("MountainCar-v0", net={"width": (0.5, 0.1)})
    assert config.widths == pytest.approx([0.9, 0.014])
    agent, _ = build(config)
    assert agent.net.default_width.tolist() == pytest.approx([0.9, 0.014])


# ----------------------------------------------------------------------------- runs, end to end


@pytest.mark.parametrize("agent", ["sga", "q"])
@pytest.mark.parametrize(
    "env, network", [(env, "sofnn") for env in CLASSIC] + [(env, "fixed") for env in CLASSIC[::2]]
)
def test_a_run_trains_resumes_exactly_and_says_its_rules(
    env, agent, network, tmp_path, same_run, monkeypatch
):
    monkeypatch.setattr(gymnasium.spec(env), "max_episode_steps", 50)
    config, options = short(env, agent, network), quick_options(tmp_path)
    whole = training.train(config, options)
    first = dataclasses.replace(config, trials=1)
    parts = training.train(first, dataclasses.replace(options, name="parts"))
    training.resume(parts, options, trials=2)
    same_run(parts, whole)
    header, *lines = (whole / "trials.csv").read_text().splitlines()
    assert header.startswith("trial,steps,decisions,total_steps,reward,rules,")
    assert [int(line.split(",")[1]) <= 50 for line in lines] == [True, True]
    config, learner, _, _ = evaluate.load(whole)
    records = evaluate.evaluate(config, learner, 2)
    assert records == evaluate.evaluate(config, learner, 2)
    assert set(evaluate.summarise(records)) == {"return", "steps"}
    sentence = words.read(learner).sentences()[0]
    assert sentence.startswith(f"IF {config.task.axes[0].name} is about ")


def test_the_film_shows_the_trial_that_evaluation_plays(toy, monkeypatch):
    config = short(toy(steps=7))
    agent, env = build(config)
    training.play(env, agent)
    monkeypatch.setattr(Toy, "render", lambda self: len(self.taken), raising=False)
    before = agent.rng.bit_generator.state
    assert list(film(config, agent, seed=4)) == list(range(8))
    assert list(film(config, agent, seed=4, limit=3)) == list(range(4))
    assert agent.rng.bit_generator.state == before


def test_the_film_shows_the_states_that_evaluation_meets(toy, monkeypatch):
    config, met, observe = short(toy(steps=3)), [], Toy._observe
    agent, env = build(config)
    training.play(env, agent)

    def noted(self):
        met.append(observe(self))
        return met[-1]

    monkeypatch.setattr(Toy, "_observe", noted)
    monkeypatch.setattr(Toy, "render", lambda self: met[-1][0], raising=False)
    frames = list(film(config, agent, seed=4))
    met.clear()
    evaluate.evaluate(config, agent, 1, seed=4)
    assert frames == [state[0] for state in met[-4:]]


def test_a_state_is_given_in_the_units_of_the_task(tmp_path, capsys, monkeypatch):
    run = str(training.train(short("MountainCar-v0"), quick_options(tmp_path)))

    def call(*numbers):
        monkeypatch.setattr("sys.argv", ["rules", run, "--at", *numbers])
        try:
            rules_main()
        except SystemExit as stop:
            assert stop.code in (0, 2)
        return capsys.readouterr()

    assert "at position -0.50, velocity 0.010:" in call("-0.5", "0.01").out
    assert "velocity 3 is out of its range, -0.07 to 0.07" in call("-0.5", "3").err
    assert "--at needs 2 numbers (position, velocity), got 3" in call("0", "0", "0").err


def test_a_task_that_knows_success_is_judged_by_it(toy, tmp_path):
    run = training.train(short(toy(success=True)), quick_options(tmp_path))
    header, line, _ = (run / "trials.csv").read_text().splitlines()
    assert dict(zip(header.split(","), line.split(","), strict=True))["success"] == "True"
    config, agent, _, _ = evaluate.load(run)
    assert evaluate.summarise(evaluate.evaluate(config, agent, 2))["success"].value == 1


def test_learners_see_scaled_rewards_and_records_the_real_ones(toy):
    agent, env = build(dataclasses.replace(short(toy(reward=-4.0)), reward_scale=0.5))
    record, _ = training.play(env, agent)
    assert record.reward == -12
    assert agent.memory.rows[:3, -4].tolist() == [-2.0] * 3  # reward, continues, two inputs


# ------------------------------------------------------------------------------------- learning


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "trials", "least"),
    [
        ("MountainCar-v0", 150, -175),  # chance: -200
        ("CartPole-v1", 120, 47),  # 22
        ("Acrobot-v1", 100, -400),  # -500
        ("MountainCarContinuous-v0", 60, 0),  # -33, and 0 for doing nothing
        ("Pendulum-v1", 100, -1000),  # -1200
    ],
)
def test_q_learning_learns_tasks_that_it_does_not_know(env, trials, least, tmp_path, monkeypatch):
    """With axes, scale and optimism from random play most seeds are far from chance."""
    monkeypatch.setattr("sofnn_torch.tasks.env.KNOWN", {})
    look.cache_clear()
    survey.survey.cache_clear()
    returns = []
    try:
        for seed in range(3):
            config = Config(env=env, agent="q", seed=seed, trials=trials)
            assert config.task.axes[0].name == "obs 1"
            run = training.train(config, quick_options(tmp_path / str(seed)))
            config, learner, _, _ = evaluate.load(run)
            records = evaluate.evaluate(config, learner, 10)
            returns.append(sum(record.reward for record in records) / len(records))
    finally:
        look.cache_clear()
        survey.survey.cache_clear()
    assert sorted(returns)[1] > least


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["sga", "q"])
@pytest.mark.parametrize(
    ("env", "trials", "random"), [("MountainCar-v0", 150, -200), ("CartPole-v1", 120, 22)]
)
def test_the_defaults_learn(agent, env, trials, random, tmp_path):
    """The greedy policies of most seeds are far from chance."""
    returns = []
    for seed in range(3):
        config = Config(env=env, agent=agent, seed=seed, trials=trials)
        run = training.train(config, quick_options(tmp_path / str(seed)))
        config, learner, _, _ = evaluate.load(run)
        records = evaluate.evaluate(config, learner, 10)
        returns.append(sum(record.reward for record in records) / len(records))
    assert sorted(returns)[1] > random + 25
