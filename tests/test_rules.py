"""Rules can be read, written and loaded: bit for bit, or with one clear line."""

import csv
import io
import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import contents, equal, parameters, quick_options, settings, written
from PIL import Image
from rich.console import Console

from sofnn_torch import evaluate, training
from sofnn_torch.network.sofnn import SOFNN
from sofnn_torch.rules import __main__ as rules
from sofnn_torch.rules import played, tables, words
from sofnn_torch.runs import checkpoint, rule_files
from sofnn_torch.runs.directory import load_config
from sofnn_torch.runs.factory import make_agent

SHORT = {"max_steps": 80}
ADAPT = {"rate_centre": 1e-4, "rate_width": 1e-4}  # numbers with all their digits
VARIANTS = {
    "three": settings("sga", sga=ADAPT),
    "steer": settings("sga", maze={"actions": "steer"}),
    "wheels": settings("sga", maze={"actions": "wheels"}),
    "constant": settings("sga", sga={"baseline": "constant", "replays": 0}, pose="true"),
    "shared": settings("sga", net={"growth": "input"}),
    "grid": settings("sga", "fixed"),
    "q-onehot": settings("q", q=ADAPT),
    "q-wheels": settings("q", q={"coding": "wheels", "rate_state": 0.1}),
    "q-scalar": settings("q", q={"coding": "scalar", "rate_constant": 0.1}),
    "q-segments": settings("q", maze={"actions": "steer"}, q={"segments": 7}),
    "q-antecedent": settings("q", q={"coding": "antecedent", "rate_constant": 0.1}),
    "q-grid": settings("q", "fixed"),
}
each_variant = pytest.mark.parametrize("variant", VARIANTS)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Makes runs of two short trials, each once; tests must not write into them."""
    made, runs = {}, tmp_path_factory.mktemp("runs")

    def train(variant):
        if variant not in made:
            config = replace(VARIANTS[variant], trials=2)
            config = replace(config, maze=replace(config.maze, **SHORT))
            made[variant] = training.train(config, quick_options(runs, name=variant))
        return made[variant]

    return train


@pytest.fixture
def run(trained, tmp_path):
    """A copy of the run `three` in a directory of its own."""
    return shutil.copytree(trained("three"), tmp_path / "runs" / "run")


STATES = np.random.default_rng(0).uniform([0, 0, -4], [1, 1, 4], (20, 3)).astype(np.float32)


# ---------------------------------------------------------------------------------- round trip


@each_variant
@pytest.mark.parametrize("suffix", [".json", ".csv"])
def test_rules_come_back_bit_for_bit(trained, tmp_path, variant, suffix):
    _, agent, _, _ = evaluate.load(trained(variant))
    kind, before = rule_files.schema(agent), agent.net.table().detach().clone()
    table = rule_files.read(written(agent, tmp_path / f"rules{suffix}"), kind)
    assert table.tobytes() == parameters(agent).tobytes()
    answers = [agent.act(state) for state in STATES]
    labels = agent.net.labels.clone()
    agent.net.replace_rules(*torch.from_numpy(table).split_with_sizes(agent.net.parts, 1))
    assert torch.equal(agent.net.table().detach(), before)
    assert torch.equal(agent.net.labels, labels)
    assert all(map(np.array_equal, (agent.act(state) for state in STATES), answers))


def test_every_float_survives():
    bits = np.random.default_rng(1).integers(0, 2**32, 100_000, np.uint32)
    numbers = bits.view(np.float32)
    numbers = np.append(numbers[np.isfinite(numbers)], np.float32([0.0, -0.0, 0.1, 2**24 + 2]))
    texts = list(map(repr, rule_files.shortest(numbers).tolist()))
    assert np.float32(list(map(float, texts))).tobytes() == numbers.tobytes()
    assert rule_files.shortest(np.float32([0.06, -0.45])).tolist() == [0.06, -0.45]


def test_a_checkpoint_file_stands_for_its_run(run, tmp_path, call):
    file = run / "checkpoint-2.pt"
    lone = Path(shutil.copy(file, tmp_path / "lone.pt"))
    texts = [call(path, "--top", 3)[1].split(": ", 1) for path in (run, file, lone)]
    assert [text[0] for text in texts] == [str(path) for path in (file, file, lone)]
    assert len({text[1] for text in texts}) == 1
    edited = written(evaluate.load(file)[1], tmp_path / "rules.json")
    assert call(file, "--load", edited)[0] == 0
    assert checkpoint.find_latest(run.with_name("run-edited"))[1]["trial"] == 2
    code, _, error = call(lone, "--load", edited)
    assert code == 2 and "--load needs a run directory or a checkpoint in one" in error


def test_files_that_were_written_are_named(run, tmp_path, call):
    files = [tmp_path / "rules.json", tmp_path / "rules.csv"]
    code, text, _ = call(run, "--json", files[0], "--csv", files[1])
    assert code == 0 and text.splitlines()[-2:] == [f"written: {file}" for file in files]
    assert "took no part" in text and "THEN" not in text


def test_a_pose_outside_the_maze_is_answered_with_a_warning(run, call):
    code, text, error = call(run, "--at", 5, 0.5, 0)
    (line,) = error.splitlines()
    assert code == 0 and "action: " in text
    assert line == "warning: --at 5 0.5 is outside the maze of 1 x 1 m"
    assert not call(run, "--at", 0.5, 0.5, 0)[2]


@pytest.mark.parametrize("variant", ["three", "shared", "grid", "q-onehot", "q-antecedent"])
def test_unchanged_rules_make_a_run_that_goes_on_like_the_old_one(trained, tmp_path, call, variant):
    runs = tmp_path / "runs"
    old = shutil.copytree(trained(variant), runs / "run")
    file = written(evaluate.load(old)[1], tmp_path / "rules.json")
    before = contents(runs)
    code, printed, _ = call(old, "--load", file)
    assert code == 0 and "run-edited: " in printed
    assert {path: data for path, data in contents(runs).items() if path in before} == before
    new = runs / "run-edited"
    (_, state, _), (_, source, _) = map(checkpoint.find_latest, (new, old))
    for part in ("config", "trial", "total_steps", "env"):
        assert equal(state[part], source[part]), part
    assert all(equal(state["agent"][k], source["agent"][k]) for k in ("rng", "value"))
    assert equal(state["agent"].get("memory"), source["agent"].get("memory"))
    assert not state["agent"]["net"]["traces"].any()
    assert not state["agent"]["net"]["usage"].any()
    assert (state["recent"], state["best"]) == ([], [])
    assert (new / "trials.csv").read_bytes() == (old / "trials.csv").read_bytes()
    assert load_config(new) == load_config(old)
    (session,) = json.loads((new / "config.json").read_text())["earlier"]
    assert session["edited"]["rules"] == str(file) and session["versions"]
    for path in (old, new):
        training.resume(path, quick_options(runs), trials=4)
    assert (new / "trials.csv").read_bytes() == (old / "trials.csv").read_bytes()
    (_, state, _), (_, source, _) = map(checkpoint.find_latest, (new, old))
    assert torch.equal(*(s["agent"]["net"]["blocks.consequents.0"] for s in (state, source)))
    assert json.loads((new / "config.json").read_text())["earlier"] == [session]


def test_new_runs_get_free_names(run, tmp_path, call, monkeypatch):
    file = written(evaluate.load(run)[1], tmp_path / "rules.csv")
    monkeypatch.chdir(run)
    assert call(".", "--load", file, "--name", "beside")[0] == 0
    shutil.rmtree(run.with_name("beside"))
    for flags in ([], [], ["--name", "mine"]):
        assert call(run, "--load", file, *flags)[0] == 0
    names = {path.name for path in run.parent.iterdir()}
    assert names == {"run", "run-edited", "run-edited-2", "mine"}
    code, _, error = call(run, "--load", file, "--name", "mine")
    assert code == 2 and "exists" in error


# -------------------------------------------------------------------------------------- editing


@pytest.mark.parametrize(("mean", "action"), [(-1.0, 0), (0.0, 1), (1.0, 2)])
def test_rules_may_be_changed_dropped_and_added(run, tmp_path, call, mean, action):
    file = tmp_path / "rules.json"
    assert call(run, "--json", file)[0] == 0
    data = json.loads(file.read_text())
    far = {"centre": [0.9, 0.9, 3.0], "width": [0.05, 0.05, 0.5], "consequents": [mean, 0.1, 0.5]}
    data["rules"][2]["note"] = "anything may stand here"
    data["rules"] = [*data["rules"][1:], far]
    file.write_text(json.dumps(data))
    code, text, _ = call(run, "--load", file)
    assert code == 0 and f"run-edited: {len(data['rules'])} rules" in text
    before, after = (evaluate.load(path)[1] for path in (run, run.with_name("run-edited")))
    assert np.array_equal(parameters(after)[:-1], parameters(before)[1:])
    assert after.act(np.float32([0.9, 0.9, 3.0])) == action  # no other rule is near
    assert (
        f"action: {after.choices[action]}"
        in call(run.with_name("run-edited"), "--at", 0.9, 0.9, math.degrees(3.0))[1]
    )


def test_a_spreadsheet_may_edit_a_consequent(run, tmp_path, call):
    file, k = tmp_path / "rules.csv", 3
    assert call(run, "--csv", file)[0] == 0
    lines = list(csv.DictReader(io.StringIO(file.read_text())))
    lines[k]["mu"] = "1"
    with open(file, "w", newline="", encoding="utf-8-sig") as opened:
        table = csv.DictWriter(opened, sorted(lines[0]))  # in another order, with other line ends
        table.writeheader()
        table.writerows(lines)
    assert call(run, "--load", file)[0] == 0
    before, after = (evaluate.load(path)[1] for path in (run, run.with_name("run-edited")))
    x = before.net.centres[k : k + 1]
    share = before.net.normalised_firing(x)[0, k]
    expected = before.net(x)[0, 0] + share * (1 - before.net.consequents[k, 0])
    assert after.net(x)[0, 0].item() == pytest.approx(expected.item(), abs=1e-5)


def test_replaced_rules_grow_and_learn_on():
    net = SOFNN(3, 2, width=0.1, block_size=4, growth="input")
    for x in torch.rand(30, 3):
        net.grow(x)
    centres, widths, consequents = (
        part.clone() for part in (net.centres, net.widths, net.consequents)
    )
    labels, parts = net.labels.clone(), (centres, widths, consequents)
    net.replace_rules(*(part[5:25] for part in parts))
    assert torch.equal(net.labels, labels[:, 5:25])
    new = torch.cat([centres[:1], centres[:1] + 1])
    net.replace_rules(*(torch.cat([part, part[:2]]) for part in (new, widths[:2], consequents[:2])))
    first, second, *again = net.labels.T.tolist()
    assert again == [first, second] and not set(first) & set(second)
    (block,) = net.blocks["centres"]
    assert block.data_ptr() == net.centres.data_ptr()  # still a window into the one table
    assert net.grow(torch.tensor([5.0, 5.0, 5.0]))
    assert net.n_rules == 5 and len(net.blocks["centres"]) == 2
    assert net(torch.rand(2, 3)).shape == (2, 2)
    net.observe(torch.rand(3))
    assert net.usage.sum() == pytest.approx(1)


@pytest.mark.parametrize("what", ["none", "many", "nan", "width", "shape", "frozen"])
def test_rules_that_no_network_may_have_change_nothing(what):
    net = SOFNN(2, 1, width=0.1, max_rules=5)
    for x in torch.rand(3, 2):
        net.add_rule(x)
    before = net.table().detach().clone()
    count = {"none": 0, "many": 6, "frozen": 2}.get(what, 3)
    centres, widths, consequents = torch.zeros(count, 2), torch.ones(count, 2), torch.ones(count, 1)
    if what == "nan":
        consequents[1] = math.nan
    if what == "width":
        widths[1, 1] = 1e-4
    if what == "shape":
        consequents = consequents.expand(-1, 2)
    if what == "frozen":
        net.criterion.grows = False
    with pytest.raises(ValueError):
        net.replace_rules(centres, widths, consequents)
    assert torch.equal(net.table().detach(), before)


# -------------------------------------------------------------------------------------- reading


def small(
    *consequents, agent="sga", at=((0.15, 0.25, math.pi / 2), (0.75, 0.25, -math.pi)), **parts
):
    """A learner with a rule at each place."""
    learner = make_agent(settings(agent, **parts))
    for centre, numbers in zip(at, consequents, strict=True):
        learner.net.add_rule(torch.tensor(centre), consequents=torch.tensor(numbers))
    return learner


def printed(view, width=100):
    console = Console(width=width, file=io.StringIO())
    console.print(view)
    return console.file.getvalue()


@pytest.mark.parametrize("width", [60, 70, 80, 200])
def test_a_table_in_a_narrow_terminal_loses_nothing(width, monkeypatch):
    learner = small((0.5, 0.1, 0.65), (-0.25, 0.3, -0.001))
    view = tables.table(words.read(learner), np.array([0.25, 0.75]), top=20)
    whole = printed(view, 200)
    terminal = Console(width=width, file=io.StringIO(), force_terminal=True, color_system=None)
    monkeypatch.setattr(tables, "Console", lambda: terminal)
    tables.show(view)
    text = terminal.file.getvalue()
    assert "…" not in text and max(map(len, text.splitlines())) <= width
    assert sorted(text.split()) == sorted(whole.split()) or width < 80
    for word in ("value", "sigma", "straight", "0.30", "-0.25", "75.0%", "750"):
        assert word in text


def test_the_table_of_two_rules():
    learner = small((0.5, 0.1, 0.65), (-0.25, 0.3, -0.001))
    said = words.read(learner)
    text = printed(tables.table(said, np.array([0.25, 0.75]), top=20))
    *_, second, first = [line.split() for line in text.splitlines() if "±" in line]
    width = round(math.degrees(0.45))
    assert (
        " ".join(second) == f"2 75.0% 750 ± 60 250 ± 60 180 ± {width}° W straight -0.25 0.30 0.00"
    )
    assert " ".join(first) == f"1 25.0% 150 ± 60 250 ± 60 90 ± {width}° N left turn 0.50 0.10 0.65"
    assert said.sentences()[0] == (
        "IF x is about 150 ± 60 mm AND y is about 250 ± 60 mm AND heading is about 90 ± 26° N "
        "THEN left turn (mu 0.50, sigma 0.10, value 0.65)"
    )
    assert len(printed(tables.table(said, np.array([0.25, 0.75]), top=1)).splitlines()) == 7


def test_a_rule_that_all_rules_together_overrule_is_marked():
    # Two rules at one place: together mu = (1 - 0.5) / 2 = 0.25, straight.
    here = (0.5, 0.5, 0.0)
    learner = small(
        (1.0, 0.1, 0.0), (-0.5, 0.1, 0.0), (0.1, 0.1, 0.0), at=[here, here, (0, 0, 0.0)]
    )
    said = words.read(learner)
    assert said.consequents[""] == ["left turn", "right turn", "straight"]
    assert said.outvoted.tolist() == [True, True, False]
    assert printed(tables.table(said, np.ones(3), 0)).count("turn * ") == 2
    text = tables.summary(np.array([0.5, 0.45, 0.05]), 10, said)
    assert "3 rules: 1 make up 50 % of the firing along the trial, 2 make up 90 %, 0 took" in text
    assert "2 rules (*) are outvoted" in text
    one = replace(said, outvoted=np.array([True, False, False]))
    assert "1 rule (*) is outvoted" in tables.summary(np.ones(3) / 3, 10, one)
    assert "2 took no part" in tables.summary(np.array([0.9991, 0.0009, 0.0]), 10, said)


def test_the_values_of_q_learning():
    # f(x, a) = c_x . x + c_a . a + c at x = (0.15, 0.25, 0): 1 * 0.25 + c_a + 0.5
    at = [(0.15, 0.25, 0.0), (0.8, 0.8, 0.0)]
    learner = small((0.0, 1, 0, 3, 1, 2, 0.5), (0.0, 0, 0, 0, 0, 0, 65), agent="q", at=at)
    said = words.read(learner).consequents
    assert said[""] == ["right turn", "undecided"]
    assert [said[f"Q {name}"][0] for name in learner.choices] == ["3.75", "1.75", "2.75"]


def test_an_action_among_the_antecedents():
    # The value at the rule's own action: 0.5 * 1 + 2
    at = [(0.15, 0.25, 0.0, 1.0), (0.15, 0.25, 0.0, -1.0)]
    numbers = [(0.0, 0, 0, 0.5, 2), (0.0, 0, 0, 0, 1)]
    learner = small(*numbers, agent="q", at=at, q={"coding": "antecedent"})
    said = words.read(learner)
    assert said.antecedents["action"] == ["1.00 ± 0.30", "-1.00 ± 0.30"]
    assert said.consequents == {"Q": ["2.50", "1.00"], "best there": ["left turn"] * 2}


@pytest.mark.parametrize(
    ("degrees", "text"),
    [(0, "0° E"), (44, "44° NE"), (90, "90° N"), (180, "180° W"), (-91, "-91° S"), (359, "-1° E")],
)
def test_directions(degrees, text):
    assert words.bearing(math.radians(degrees)) == text


@each_variant
def test_the_rules_at_a_state_add_up_to_what_the_learner_says(trained, variant):
    config, agent, _, _ = evaluate.load(trained(variant))
    said = words.read(agent)
    for state in STATES[:5]:
        decision = words.decide(agent, state)
        x = torch.from_numpy(state)
        with torch.no_grad():
            if config.agent == "sga":
                expected, chosen = agent.net(x[None])[0], None
            else:
                expected = agent.action_values(
                    x, agent.net.normalised_firing(agent.network_inputs(x))
                )
                chosen = agent.representatives[int(expected.argmax())]
        assert decision.outputs == pytest.approx(expected.numpy(), rel=1e-4, abs=1e-5)
        assert decision.shares.sum(0) == pytest.approx(1.0, abs=1e-5)
        action = agent.act(state)
        if agent.task.discrete:
            assert decision.action == agent.choices[action]
        else:
            assert f"{action[-1]:.2f}".replace("-0.00", "0.00") in decision.action
            assert chosen is None or f"{chosen:.2f}" in decision.action
        text = printed(tables.decision_table(said, decision, variant == "q-antecedent"))
        shown = [line.split() for line in text.splitlines() if "±" in line]
        total = sum(float(words[1].rstrip("%")) for words in shown)
        assert 98.5 < total < 100.5
        # Every column but the last rules' is the weighted mean of what is shown.
        if len(decision.names) <= words.MANY:
            last = text.splitlines()[-2].split()[2:]
            assert list(map(float, last)) == pytest.approx(decision.outputs, abs=0.006)


@each_variant
def test_the_command_reads_every_kind_of_rule(trained, tmp_path, call, variant):
    path = trained(variant)
    before, count = contents(path), evaluate.load(path)[1].net.n_rules
    code, text, _ = call(path, "--top", 5)
    assert code == 0
    assert "2 trials learned" in text and "took no part" in text
    assert sum("±" in line for line in text.splitlines()) == min(5, count)
    assert "…" not in text and max(map(len, text.splitlines()[2:])) <= 100
    code, text, _ = call(path, "--at", 0.15, 0.15, -90)
    assert code == 0
    assert "at x 150 mm, y 150 mm, heading -90° S:" in text and "action: " in text
    assert "…" not in text and max(map(len, text.splitlines()[1:])) <= 100
    assert contents(path) == before


def test_usage_follows_the_pose_that_the_learner_sees(trained):
    config, agent, _, _ = evaluate.load(trained("constant"))  # sees its true pose
    shares, trial = rules.firing_along_a_trial(config, agent, seed=3)
    assert shares.sum() == pytest.approx(1, abs=1e-5)
    assert played.outcome(trial.record) == "no goal after 80 steps"
    assert trial.record.decisions == len(trial.states) >= 8
    again = rules.firing_along_a_trial(config, agent, seed=3)
    assert np.array_equal(shares, again[0])


def test_ten_thousand_rules_are_read_at_once(monkeypatch):
    agent = small(at=())
    count = 10_000
    columns = torch.rand(count, 3), torch.full((count, 3), 0.1), torch.rand(count, 3)
    agent.net.replace_rules(*columns)
    calls = 0
    real = agent.net.normalised_firing

    def counted(*arguments):
        nonlocal calls
        calls += 1
        return real(*arguments)

    monkeypatch.setattr(agent.net, "normalised_firing", counted)
    assert len(words.read(agent).sentences()) == count
    assert calls <= 2 + count // 512


@pytest.mark.parametrize(("variant", "suffix"), [("three", ".png"), ("q-antecedent", ".svg")])
def test_the_picture(trained, tmp_path, call, variant, suffix):
    file = tmp_path / f"rules{suffix}"
    assert call(trained(variant), "--picture", file)[0] == 0
    if suffix == ".png":
        picture = Image.open(file)
        assert picture.size == (1440, 780) and len(picture.getcolors(10**6)) > 50
    else:
        assert file.read_text().startswith("<?xml")
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == [file.name]


def test_endings_may_have_capitals(run, tmp_path, call):
    wanted = [tmp_path / name for name in ("r.JSON", "r.Csv", "r.PNG")]
    flags = zip(("--json", "--csv", "--picture"), wanted, strict=True)
    assert call(run, *(word for pair in flags for word in pair))[0] == 0
    assert wanted[0].read_bytes()[:1] == b"{" and wanted[1].read_text().startswith("rule,")
    assert Image.open(wanted[2]).format == "PNG"
    for file in wanted[:2]:
        assert call(run, "--load", file, "--name", file.suffix[1:])[0] == 0


def test_files_are_the_same_every_time(run, tmp_path, call):
    texts = []
    for name in ("a", "b"):
        flags = [f"--{kind}={tmp_path / name}.{kind}" for kind in ("json", "csv")]
        assert call(run, *flags)[0] == 0
        texts.append([(tmp_path / f"{name}.{kind}").read_text() for kind in ("json", "csv")])
    assert texts[0] == texts[1]
    data = json.loads(texts[0][0])
    assert [rule["rule"] for rule in data["rules"]] == [*range(1, len(data["rules"]) + 1)]
    assert sum(rule["usage"] for rule in data["rules"]) == pytest.approx(1, abs=1e-5)
    assert data["inputs"][2] == {"name": "heading", "unit": "rad"}
    lines = list(csv.DictReader(io.StringIO(texts[0][1])))
    assert [line["text"] for line in lines] == [rule["text"] for rule in data["rules"]]


# --------------------------------------------------------------------------------- what is wrong


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "RUN"),
        (["nowhere"], "not a run directory"),
        (["RUN", "--tpo", "3"], "did you mean --top?"),
        (["RUN", "--top", "-1"], "--top must not be negative"),
        (["RUN", "--seed", "-1"], "--seed must not be negative"),
        (["RUN", "--at", "0.1", "0.1"], "--at needs 3 numbers (x, y, heading), got 2"),
        (["RUN", "--at", "0.1", "nan", "0"], "--at must be numbers or None, got"),
        (["RUN", "--at", "0.1,", "0.1,", "0"], "must be numbers or None, got '0.1, 0.1, 0'"),
        (["RUN", "--at", "1_0", "0.1", "0"], "--at must be numbers or None, got"),
        (["RUN", "--json", "rules.csv"], "--json must end in .json"),
        (["RUN", "--csv", "rules"], "--csv must end in .csv"),
        (["RUN", "--picture", "rules.gif"], "--picture must end in .png or .svg or .pdf"),
        (["RUN", "--json", "nowhere/rules.json"], "not a file in an existing directory"),
        (["RUN", "--name", "mine"], "--name goes with --load"),
        (["RUN", "--load", "r.json", "--name", "a/b"], "plain directory name"),
        (["RUN", "--load", "r.json", "--csv", "r.csv"], "do not go together"),
        (["RUN", "--at", "0", "0", "0", "--csv", "r.csv"], "do not go together"),
        (["RUN", "--load", "nowhere.json"], "nowhere.json: no such file"),
        (["RUN", "--load", "folder.json"], "folder.json: no such file"),
        (["RUN", "--load", "rules.pkl"], "rules.pkl: a rule file ends in .json or .csv"),
        (["EMPTY"], "no rule has been learned yet"),
        (["DAMAGED"], "damaged"),
    ],
)
def test_bad_input_gives_one_line_and_exit_code_2(
    run, tmp_path, monkeypatch, call, arguments, message
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.json").mkdir()
    folders = {"RUN": run}
    for name, number in (("EMPTY", 0), ("DAMAGED", 2)):
        folders[name] = shutil.copytree(run, tmp_path / name)
        for file in folders[name].glob("*.pt"):
            if number == 2:
                file.write_bytes(file.read_bytes()[:-1])
            elif file.name != "checkpoint-0.pt":
                file.unlink()
    before = contents(tmp_path)
    code, _, error = call(*(folders.get(word, word) for word in arguments))
    (line,) = error.splitlines()
    assert code == 2 and line.startswith("error: ") and message in line
    assert contents(tmp_path) == before


def test_a_fixed_network_keeps_its_number_of_rules(trained, tmp_path, call):
    path = trained("grid")
    agent = evaluate.load(path)[1]
    file = written(agent, tmp_path / "rules.csv", parameters(agent)[1:])
    code, _, error = call(path, "--load", file, "--name", "other")
    assert code == 2 and "63 rules, must be 64 rules, as the fixed network has" in error
    assert not path.with_name("other").exists()


@pytest.mark.parametrize("flag", ["--json", "--csv", "--picture", "--load"])
def test_a_disk_that_refuses_is_one_line(run, tmp_path, monkeypatch, call, flag):
    suffix = {"--picture": ".png", "--load": ".json"}.get(flag, f".{flag[2:]}")
    file = tmp_path / f"rules{suffix}"
    if flag == "--load":
        written(evaluate.load(run)[1], file)
    before = contents(tmp_path)

    def refuse(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint.os, "replace", refuse)
    code, _, error = call(run, flag, file)
    (line,) = error.splitlines()
    assert code == 2 and "No space left on device" in line
    assert contents(tmp_path) == before and [p.name for p in run.parent.iterdir()] == ["run"]
