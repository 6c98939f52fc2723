"""A run that begins with rules from a file: it keeps them, learns on, and is like any other run."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import contents, parameters, quick_options, settings, written

from sofnn_torch import SOFNN, cli, evaluate, training
from sofnn_torch.runs import checkpoint, rule_files, session
from sofnn_torch.runs.directory import load_config
from sofnn_torch.runs.factory import make_agent
from sofnn_torch.runs.places import default_name
from sofnn_torch.runs.settings import Config, from_dict

RULES = Path(__file__).parents[1] / "examples" / "rules"


def short(agent="sga", trials=4, **changes):
    config = Config(agent=agent, rules=RULES / f"{agent}.csv", trials=trials, **changes)
    return dataclasses.replace(config, maze=dataclasses.replace(config.maze, max_steps=200))


@pytest.mark.parametrize("agent", ["sga", "q"])
def test_ten_rules_by_hand_drive_to_the_goal_in_every_trial(agent):
    config = Config(agent=agent, rules=RULES / f"{agent}.csv")
    records = evaluate.evaluate(config, make_agent(config), 4)
    assert all(record.success and record.steps < 620 for record in records)


def test_a_run_that_begins_with_rules_says_so_in_its_name():
    assert default_name(short("q", seed=3)) == "q-sofnn-rules-estimated-s3"
    assert default_name(Config(agent="q", seed=3)) == "q-sofnn-estimated-s3"


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["sga", "q"])
@pytest.mark.parametrize("seed", range(5))
def test_learning_on_from_ten_rules_never_loses_the_way(agent, seed):
    """Trials 2 to 10 are at most twice as long as the first, and all arrive."""
    learner, env = session.build(
        Config(agent=agent, rules=RULES / f"{agent}.csv", seed=seed, trials=10)
    )
    steps = [training.play(env, learner)[0].steps for _ in range(10)]
    assert steps[0] < 700 and max(steps) <= 2 * steps[0]


def test_settings_hold_the_rules_themselves():
    config = Config(rules=RULES / "sga.csv")
    assert config.rules == (RULES / "sga.csv").read_text()
    assert from_dict(json.loads(config.to_json())) == config
    expected = np.loadtxt(RULES / "sga.csv", delimiter=",", skiprows=1, dtype=np.float32)
    assert np.array_equal(parameters(make_agent(config)), expected)


def test_json_on_one_line_is_rules_too(tmp_path):
    file = written(make_agent(short()), tmp_path / "rules.json")
    file.write_text(json.dumps(json.loads(file.read_text())))
    assert np.array_equal(
        parameters(make_agent(Config(rules=file))), parameters(make_agent(short()))
    )


def test_a_new_run_needs_no_file_any_more(tmp_path, call, monkeypatch):
    file = tmp_path / "mine.csv"
    file.write_bytes((RULES / "sga.csv").read_bytes())
    flags = ("--runs", tmp_path, "--name", "new", "--maze.max-steps", 200, "--trials", 2)
    code, text, _ = call("--new", file, *flags)
    assert code == 0 and "10 rules, nothing learned yet" in text
    file.unlink()
    run = tmp_path / "new"
    assert call(run, "--top", 3)[0] == 0
    loaded = evaluate.load(run)
    assert loaded.state["trial"] == 0 and loaded.agent.net.n_rules == 10
    training.resume(run, quick_options(tmp_path))
    assert evaluate.load(run).state["trial"] == 2


@pytest.mark.parametrize("agent", ["sga", "q"])
def test_a_resumed_run_is_as_one_that_never_stopped(agent, tmp_path, same_run):
    net = dataclasses.replace(short(agent).net, growth="rule", theta=0.2)
    config = dataclasses.replace(short(agent, 4), net=net)
    whole = training.train(config, quick_options(tmp_path, name="whole"))
    half = dataclasses.replace(config, trials=2)
    part = training.train(half, quick_options(tmp_path, name="part"))
    training.resume(part, quick_options(tmp_path), 4)
    same_run(whole, part)


@pytest.mark.parametrize("agent", ["sga", "q"])
def test_rate_0_keeps_given_rules_while_new_ones_learn(agent, tmp_path):
    config = short(agent, 2, rules_rate=0.0)
    net = dataclasses.replace(config.net, growth="rule", theta=0.3)
    own = dataclasses.replace(getattr(config, agent), replays=5)
    config = dataclasses.replace(config, net=net, **{agent: own})
    before = parameters(make_agent(config))
    run = training.train(config, quick_options(tmp_path, name="run"))
    after = evaluate.load(run).agent
    assert np.array_equal(parameters(after)[:10], before)
    assert after.net.n_rules > 10
    learned = checkpoint.load(run / "checkpoint-2.pt")["agent"]["net"]
    assert learned["traces"].abs().sum() > 0


def test_given_rules_learn_at_their_share_of_the_rates():
    net = SOFNN(1, 2, width=1.0)
    for x in (0.0, 5.0, 10.0):
        net.add_rule(torch.tensor([x]), consequents=torch.zeros(2))
    net.given, net.given_rate = 2, 0.25
    net.accumulate(torch.ones(2, 3), 0.0)
    net.adapt(torch.tensor([[1.0], [2.0]]), 4.0)
    assert net.consequents.tolist() == [[1, 2], [1, 2], [4, 8]]
    net.adapt_batch(torch.tensor([[1.0], [2.0]]), torch.ones(2, 3), torch.ones(3))
    assert net.consequents.tolist() == [[1.25, 2.5], [1.25, 2.5], [5, 10]]


@pytest.mark.parametrize("agent", ["sga", "q"])
def test_a_new_rule_begins_with_what_all_say_there(agent):
    learner, x = make_agent(short(agent)), torch.tensor([0.55, 0.3, 1.0])
    before = learner.net(x[None]).detach()
    assert learner.net.add_rule(x)
    assert torch.allclose(learner.net(x[None]).detach(), before, atol=1e-4)
    assert torch.allclose(learner.net.consequents[-1], before[0], atol=1e-4)


def test_edited_rules_become_the_given_ones(tmp_path, call):
    run = training.train(short(trials=1), quick_options(tmp_path, name="run"))
    agent = make_agent(short())
    file = written(agent, tmp_path / "few.csv", parameters(agent)[:4])
    assert call(run, "--load", file, "--name", "few")[0] == 0
    config, edited, _, state = evaluate.load(tmp_path / "few")
    assert edited.net.n_rules == edited.net.given == 4
    again = make_agent(config)
    assert np.array_equal(parameters(again), parameters(agent)[:4])
    assert load_config(run).rules != config.rules and state["config"]["rules"] == config.rules


@pytest.mark.slow
def test_several_seeds_begin_with_the_rules_too(tmp_path):
    flags = f"--rules {RULES / 'sga.csv'} --runs {tmp_path} --name run --seeds 3 --trials 1"
    assert cli.main([*flags.split(), "--maze.max-steps", "100", "--quiet"]) == 0
    assert evaluate.load(tmp_path / "run-s3").agent.net.n_rules == 10


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("--new none.csv", "--rules none.csv: no such file"),
        ("--new rules.txt", "--rules rules.txt: a rule file ends in .json or .csv"),
        ("--new q.csv", "--rules: column mu is missing"),
        ("--new far.csv", "--rules: rule 1, centre_x_m: must lie between"),
        ("--new sga.csv --seeds 0-2", "--new goes with neither"),
        ("--new sga.csv --name a/b", "--name must be a plain directory name"),
    ],
)
def test_what_cannot_begin_is_one_line_and_leaves_nothing(tmp_path, call, monkeypatch, flags, said):
    monkeypatch.chdir(tmp_path)
    for name in ("sga.csv", "q.csv"):
        (tmp_path / name).write_bytes((RULES / name).read_bytes())
    (tmp_path / "rules.txt").write_text("no\n")
    (tmp_path / "far.csv").write_text((RULES / "sga.csv").read_text().replace("0.35,", "350,", 1))
    before = contents(tmp_path)
    code, _, error = call(*flags.split())
    assert code == 2 and said in error and len(error.strip().splitlines()) == 1
    assert contents(tmp_path) == before


def test_a_rate_for_given_rules_needs_rules():
    with pytest.raises(ValueError, match=r"--rules-rate has no effect without --rules"):
        cli.parse(["--rules-rate", "0.5"])


def test_a_fixed_structure_can_be_given_by_rules():
    config = settings(net={"growth": "frozen"})
    config = dataclasses.replace(config, rules=(RULES / "sga.csv").read_text())
    agent = make_agent(config)
    assert agent.net.n_rules == 10 and rule_files.schema(agent).counts == (1, 50_000)
