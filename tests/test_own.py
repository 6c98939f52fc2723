"""A learner of one's own goes through the package's own loop; no file of the package changes."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import quick_options

from sofnn_torch import SOFNN, Config, NetworkConfig, load, resume, train
from sofnn_torch.cli import main
from sofnn_torch.evaluate import evaluate
from sofnn_torch.rules import __main__ as rules
from sofnn_torch.rules import words
from sofnn_torch.runs import checkpoint, rule_files

OWN = "own:Sarsa"


def config(trials=4, **changes):
    base = Config(agent=OWN, trials=trials, own={"epsilon": 0.2})
    return replace(base, maze=replace(base.maze, max_steps=200), **changes)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return train(config(), quick_options(tmp_path_factory.mktemp("own")))


def test_it_learns_what_sarsa_learns(run):
    # The last decision of a trial that reaches the goal: Q += rate S (r - Q).
    agent = load(run).agent
    agent.start(np.float32([0.2, 0.2, 0.0]))
    before, x = agent.net.consequents.clone(), torch.tensor([[0.2, 0.2, 0.0]])
    firing, value = agent.net.normalised_firing(x)[0].detach(), agent.value
    agent.step(1.0, np.float32([0.2, 0.2, 0.0]), True)
    change = (agent.net.consequents - before).abs().sum(1)
    torch.testing.assert_close(change, (0.5 * (1.0 - value) * firing).abs())


def test_it_trains_stops_and_goes_on_to_the_last_bit(run, tmp_path, same_run):
    half = train(config(trials=2), quick_options(tmp_path))
    assert half.name == "sarsa-sofnn-estimated-s0"
    same_run(resume(half, quick_options(tmp_path), trials=4), run)


def test_it_is_loaded_and_evaluated(run):
    loaded = load(run)
    assert type(loaded.agent).__name__ == "Sarsa" and loaded.agent.settings.epsilon == 0.2
    records = evaluate(loaded.config, loaded.agent, episodes=2)
    assert [record.steps for record in records] == [200, 200]


def test_its_rules_are_words_files_and_a_picture(run, tmp_path, capsys):
    rules.run(rules.Options(run=run, csv=tmp_path / "r.csv", picture=tmp_path / "r.png"))
    agent = load(run).agent
    table = rule_files.read(tmp_path / "r.csv", rule_files.schema(agent))
    assert np.array_equal(table[:, -3:], agent.net.consequents.numpy())
    assert "Q_right_turn" in (tmp_path / "r.csv").read_text().splitlines()[0]
    best = agent.net.consequents[0].argmax()
    sentence = words.read(agent).sentences()[0]
    assert f"THEN {('right turn', 'straight', 'left turn')[best]} (Q right turn" in sentence


def test_the_command_line_finds_it(tmp_path):
    words = ["--agent", OWN, "--own", "epsilon", "0.3", "--trials", "1", "--maze.max-steps", "50"]
    assert main([*words, "--quiet", "--runs", str(tmp_path)]) == 0
    (path,) = tmp_path.iterdir()
    assert load(path).agent.settings.epsilon == pytest.approx(0.3)


def test_a_criterion_of_ones_own_adds_rules_where_it_says():
    net = SOFNN(1, 1, width=1.0, theta=0.5, growth="own:Pairs")
    # A rule fires by 0.5 up to sqrt(2 ln 2) = 1.18 widths away.
    grown = [net.grow(torch.tensor([x])) for x in (0.0, 0.0, 1.1, -1.1, 1.2, 1.25, 1.21)]
    assert grown == [True, True, False, False, True, True, False]
    assert net.growth == "own:Pairs" and net.theta == 0.5


def test_a_criterion_of_ones_own_trains_stops_and_goes_on_to_the_last_bit(tmp_path, same_run):
    settings = config(trials=2, agent="q", own=(), net=NetworkConfig(growth="own:Pairs"))
    whole = train(settings, quick_options(tmp_path / "whole", checkpoint_every=1))
    half = train(replace(settings, trials=1), quick_options(tmp_path, checkpoint_every=1))
    _, state, _ = checkpoint.find_latest(half)
    assert state["network"]["growth"] == "own:Pairs" and state["network"]["rules"] > 10
    same_run(resume(half, quick_options(tmp_path, checkpoint_every=1), trials=2), whole)
    loaded = load(whole)
    assert loaded.agent.net.growth == "own:Pairs" == loaded.config.net.growth
    records = evaluate(loaded.config, loaded.agent, episodes=1)
    assert len(words.read(loaded.agent).sentences()) == loaded.agent.net.n_rules
    assert len(records) == 1


@pytest.mark.parametrize(
    ("growth", "message"),
    [
        ("pairs", "no growth criterion 'pairs': give rule, input, literal, frozen or module:Class"),
        ("own:Trios", "no growth criterion 'own:Trios' (module 'own' has no attribute 'Trios')"),
        ("nowhere:Pairs", "No module named 'nowhere'"),
        ("own:Sarsa", "own:Sarsa is no class of sofnn_torch.network.growth.Criterion"),
        ("own:Greedy", "own:Greedy cannot be made from theta alone"),
        ("", "no growth criterion ''"),
    ],
)
def test_an_unknown_criterion_is_one_line(growth, message):
    with pytest.raises(ValueError, match=re.escape(message)) as refusal:
        Config(net=NetworkConfig(growth=growth))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"agent": "own:Nobody"}, "has no attribute 'Nobody'"),
        ({"agent": "nowhere:Sarsa"}, "No module named 'nowhere'"),
        ({"agent": "own:SarsaConfig"}, "which is none"),
        ({"agent": "sarsa"}, "--agent must be sga, q or module:Class"),
        ({"agent": OWN, "own": {"epsilon": 2}}, r"--own.epsilon must lie in \[0, 1\], got 2"),
        ({"agent": OWN, "own": {"speed": 2}}, "'own.speed' is not a setting"),
        ({"agent": "q", "own": {"speed": 2}}, "--own is for a learner of one's own"),
    ],
)
def test_what_is_wrong_with_it_is_one_line(settings, message):
    with pytest.raises(ValueError, match=message):
        Config(**settings)
