"""Agents from Python: what they learn is what the commands learn; shapes, files, callbacks."""

import dataclasses

import gymnasium
import numpy as np
import pytest
from conftest import equal, quick_options, scalars
from gymnasium.spaces import Box, Discrete

from sofnn_torch import SGA, Agent, Axis, Config, QLearning, evaluate, training
from sofnn_torch.runs import checkpoint
from sofnn_torch.runs.session import arithmetic

FEW = {"net": {"max_rules": 100}, "replays": 1, "replay_every": 0}


class Toy(gymnasium.Env):
    """Two inputs without ends; the observation shows the last action; three steps a trial."""

    observation_space = Box(-np.inf, np.inf, (1, 2))

    def __init__(self, actions=None, steps=3):
        self.action_space = actions or Box(np.float32([-2, 0]), np.float32([2, 10]))
        self.steps = steps

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.taken = []
        return self._seen(), {}

    def step(self, action):
        assert action in self.action_space
        self.taken.append(action)
        return self._seen(), 1.0, len(self.taken) == self.steps, False, {}

    def _seen(self):
        return np.float32([[self.np_random.normal(), len(self.taken)]])


@pytest.fixture(scope="module")
def learned():
    """An agent that has learned for two trials of CartPole."""
    agent = SGA.for_env("CartPole-v1", seed=3, **FEW)
    agent.learn("CartPole-v1", trials=np.int64(2), quiet=True)
    return agent


@pytest.mark.parametrize("learner", [SGA, QLearning])
def test_an_agent_learns_what_the_command_learns(learner, tmp_path):
    config = Config(env="MountainCar-v0", agent=learner.name, seed=3, trials=2)
    changes = {
        "net": dataclasses.replace(config.net, max_rules=100),
        learner.name: dataclasses.replace(config.learner_settings, replays=1, replay_every=0),
    }
    config = dataclasses.replace(config, **changes)
    run = training.train(config, quick_options(tmp_path))
    _, state, _ = checkpoint.find_latest(run)
    env = gymnasium.make("MountainCar-v0")
    agent = learner.for_env(env, seed=np.int64(3), **FEW)
    records = agent.learn(env, trials=1, quiet=True) + agent.learn(env, trials=1, quiet=True)
    assert equal(agent.learner.state_dict(), state["agent"])
    assert [record.total_steps for record in records] == [200, 400]
    agent.save(str(tmp_path / "agent.pt"))
    stored = checkpoint.load(tmp_path / "agent.pt")
    assert equal(stored["config"], state["config"])
    loaded = evaluate.load(str(tmp_path / "agent.pt"))
    played = evaluate.evaluate(loaded.config, loaded.agent, 1)
    assert agent.evaluate("MountainCar-v0", trials=1) == played
    assert equal(Agent.load(str(run)).learner.state_dict(), agent.learner.state_dict())


def test_a_loop_of_ones_own_learns_the_same(tmp_path):
    env = Toy()
    agent, other = (SGA.for_env(env, seed=1, **FEW) for _ in range(2))
    other.learn(env, trials=1, quiet=True)
    seed = np.random.SeedSequence([agent.state_dict()["seed"], 1]).generate_state(1)[0]
    with arithmetic():
        observation, _ = env.reset(seed=int(seed))
        action = agent.start(observation)
        while action is not None:
            observation, reward, terminated, truncated, _ = env.step(action)
            action = agent.step(reward, observation, terminated, truncated)
    assert (agent.trials, agent.total_steps) == (other.trials, other.total_steps) == (1, 3)
    mine, theirs = agent.learner.state_dict(), other.learner.state_dict()
    assert equal(mine["net"], theirs["net"]) and equal(mine["rng"], theirs["rng"])


def test_learning_goes_on_from_a_file_as_if_it_had_never_stopped(tmp_path):
    env = Toy()
    whole, first = (SGA.for_env(env, seed=1, **FEW) for _ in range(2))
    whole.learn(env, trials=4, quiet=True)
    first.learn(env, trials=2, quiet=True)
    first.evaluate(env, trials=2)  # changes nothing
    first.save(tmp_path / "agent.pt")
    second = Agent.load(str(tmp_path / "agent.pt"))
    second.learn(env, trials=2, quiet=True)
    assert equal(second.learner.state_dict(), whole.learner.state_dict())
    assert (second.trials, second.total_steps) == (4, 12)
    np.testing.assert_array_equal(second.act([[0.0, 1.0]]), whole.act([[0.0, 1.0]]))


def test_many_observations_are_answered_as_each_alone(learned):
    states = np.random.default_rng(0).uniform(-0.1, 0.1, (40, 4))
    actions = learned.act(states)
    assert actions.shape == (40,) and actions.dtype == np.int64
    assert actions.tolist() == [learned.act(state) for state in states]
    agent = SGA.for_env(Toy(), **FEW)
    agent.learn(Toy(), trials=1, quiet=True)
    many = agent.act(np.zeros((5, 1, 2)))
    assert many.shape == (5, 2) and many.dtype == np.float32
    np.testing.assert_allclose(many[0], agent.act(np.zeros((1, 2))), rtol=1e-5)
    assert agent.act(np.zeros((5, 1, 2)), explore=1).std(0).min() > 0


@pytest.mark.parametrize("shape", [(3,), (), (4, 1), (2, 2, 4), (1, 3)])
def test_an_observation_of_another_shape_is_refused(learned, shape):
    said = r"has shape \(4,\), many have \(B, 4\), not "
    with pytest.raises(ValueError, match=said):
        learned.act(np.zeros(shape))


def test_what_cannot_be_asked_is_said_in_a_line(learned, tmp_path):
    with pytest.raises(ValueError, match="not finite"):
        learned.act([np.nan] * 4)
    with pytest.raises(ValueError, match="one observation at a time"):
        learned.start(np.zeros((2, 4)))
    with pytest.raises(ValueError, match="no rule has been learned yet"):
        SGA.for_env("CartPole-v1").act(np.zeros(4))
    with pytest.raises(ValueError, match=r"4 inputs need as many axes, got 2"):
        SGA.for_env("CartPole-v1", axes=[Axis("a"), Axis("b")])
    with pytest.raises(ValueError, match="trials must be at least 1"):
        learned.learn("CartPole-v1", trials=0)
    with pytest.raises(ValueError, match="temperature"):
        QLearning.for_env("CartPole-v1", temperature=-1)
    (tmp_path / "nothing.pt").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="not a checkpoint"):
        Agent.load(tmp_path / "nothing.pt")


def test_an_environment_with_other_actions_is_refused():
    agent = SGA.for_env(Toy(), **FEW)
    with pytest.raises(ValueError, match="this agent was made for actions in Box"):
        agent.learn(Toy(Discrete(3)), trials=1, quiet=True)


def test_a_callback_sees_each_trial_and_may_end_the_learning():
    agent, seen = SGA.for_env(Toy(), **FEW), []

    def callback(record):
        seen.append(record.trial)
        return record.trial < 3

    records = agent.learn(Toy(), trials=9, callback=callback, quiet=True)
    assert seen == [1, 2, 3] == [record.trial for record in records]


def test_curves_are_written_on_request(tmp_path):
    agent = SGA.for_env(Toy(), **FEW)
    for _ in range(2):
        agent.learn(Toy(), trials=2, tensorboard=str(tmp_path / "curves"), quiet=True)
    curves = scalars(tmp_path / "curves")
    assert curves["1_result/return"] == [(1, 3.0), (2, 3.0), (3, 3.0), (4, 3.0)]
    assert curves["rules/count"][-1][1] == agent.learner.net.n_rules


def test_spaces_alone_are_enough_with_ends_and_a_scale():
    robot = type("Robot", (), {})()
    robot.observation_space, robot.action_space = Box(-np.inf, np.inf, (1,)), Discrete(2, start=5)
    with pytest.raises(ValueError, match="give axes with ends and reward_scale"):
        QLearning.for_env(robot)
    agent = QLearning.for_env(robot, axes=[Axis("x", "m", 0, 1)], reward_scale=0.5)
    assert agent.start([0.5]) in (5, 6)
