"""Rules can be read, written and loaded: bit for bit, or with one clear line."""

import copy
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
from conftest import equal, quick_options, settings
from hypothesis import HealthCheck, given
from hypothesis import settings as trials_of
from hypothesis import strategies as st
from PIL import Image
from rich.console import Console

from sofnn_torch import evaluate, training
from sofnn_torch.network.sofnn import SOFNN
from sofnn_torch.rules import __main__ as rules
from sofnn_torch.rules import files, words
from sofnn_torch.runs import checkpoint
from sofnn_torch.runs.directory import load_config
from sofnn_torch.runs.factory import make_agent

SHORT = {"max_steps": 80}
ADAPT = {"rate_centre": 0.001, "rate_width": 0.001}  # numbers with all their digits
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


@pytest.fixture
def call(monkeypatch, capsys):
    """Runs the command line: its exit code, output and error stream."""

    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["rules", *map(str, arguments)])
        try:
            rules.main()
            code = 0
        except SystemExit as stop:
            code = stop.code
        return code, *capsys.readouterr()

    return run


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def parameters(agent):
    return agent.net.table().detach().T.numpy()


def written(agent, path, table=None):
    """Write rules to a file: those of the learner if no others are given."""
    write = files.to_json if path.suffix == ".json" else files.to_csv
    table = parameters(agent) if table is None else table
    path.write_bytes(write(files.schema(agent), table, {"usage": [0.5] * len(table)}))
    return path


STATES = np.random.default_rng(0).uniform([0, 0, -4], [1, 1, 4], (20, 3)).astype(np.float32)


# ---------------------------------------------------------------------------------- round trip


@each_variant
@pytest.mark.parametrize("suffix", [".json", ".csv"])
def test_rules_come_back_bit_for_bit(trained, tmp_path, variant, suffix):
    _, agent, _, _ = evaluate.load(trained(variant))
    kind, before = files.schema(agent), agent.net.table().detach().clone()
    table = files.read(written(agent, tmp_path / f"rules{suffix}"), kind)
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
    texts = list(map(repr, files.shortest(numbers).tolist()))
    assert np.float32(list(map(float, texts))).tobytes() == numbers.tobytes()
    assert files.shortest(np.float32([0.06, -0.45])).tolist() == [0.06, -0.45]


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


def test_the_table_of_two_rules():
    learner = small((0.5, 0.1, 0.65), (-0.25, 0.3, -0.001))
    said = words.read(learner)
    text = printed(rules.table(said, np.array([0.25, 0.75]), top=20))
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
    assert len(printed(rules.table(said, np.array([0.25, 0.75]), top=1)).splitlines()) == 7


def test_a_rule_that_all_rules_together_overrule_is_marked():
    # Two rules at one place: together mu = (1 - 0.5) / 2 = 0.25, straight.
    here = (0.5, 0.5, 0.0)
    learner = small(
        (1.0, 0.1, 0.0), (-0.5, 0.1, 0.0), (0.1, 0.1, 0.0), at=[here, here, (0, 0, 0.0)]
    )
    said = words.read(learner)
    assert said.consequents[""] == ["left turn", "right turn", "straight"]
    assert said.outvoted.tolist() == [True, True, False]
    assert printed(rules.table(said, np.ones(3), 0)).count("turn * ") == 2
    text = rules.summary(np.array([0.5, 0.45, 0.05]), 10, said)
    assert "3 rules: 1 make up 50 % of the firing along the trial, 2 make up 90 %, 0 took" in text
    assert "2 rules (*) are outvoted" in text
    one = replace(said, outvoted=np.array([True, False, False]))
    assert "1 rule (*) is outvoted" in rules.summary(np.ones(3) / 3, 10, one)
    assert "2 took no part" in rules.summary(np.array([0.9991, 0.0009, 0.0]), 10, said)


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
        text = printed(rules.decision_table(said, decision))
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
    shares, decisions, outcome = rules.firing_along_a_trial(config, agent, seed=3)
    assert shares.sum() == pytest.approx(1, abs=1e-5)
    assert outcome == "no goal after 80 steps" and decisions >= 8
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
        (["RUN", "--at", "0.1", "0.1"], "--at must be FLOAT FLOAT FLOAT or None, got ['0.1', '"),
        (["RUN", "--at", "0.1", "nan", "0"], "--at must be a finite number"),
        (["RUN", "--at", "inf", "0.1", "0"], "--at must be a finite number"),
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


BAD_JSON = {
    "json": ("{", "not JSON"),
    "list": ("[]", 'not a rule file: "format" must be "sofnn-torch rules"'),
    "format": ({"format": "rules"}, "not a rule file"),
    "newer": ({"version": 2}, "version 2, this program reads version 1"),
    "version": ({"version": True}, "version true"),
    "agent": ({"agent": "q"}, 'agent must be "sga" for this run'),
    "inputs": ({"inputs": ["x", "y"]}, "inputs must be"),
    "outputs": ({"outputs": ["mu"]}, 'outputs must be ["mu", "sigma", "value"]'),
    "rules": ({"rules": 3}, "rules must be a list, got 3"),
    "none": ({"rules": []}, "0 rules, must be 1 to 60"),
    "many": (lambda r: r.extend(r[:1] * 60), "rules, must be 1 to 60"),
    "rule": (lambda r: r.insert(1, None), "rule 2: must be an object, got null"),
    "missing": (
        lambda r: r[1].pop("width"),
        "rule 2, width: must be a list of 3 numbers, got null",
    ),
    "short": (lambda r: r[1]["centre"].pop(), "rule 2, centre: must be a list of 3 numbers, got 2"),
    "text": (lambda r: put(r, "centre", "1"), 'rule 3, centre_y_m: must be a number, got "1"'),
    "true": (lambda r: put(r, "centre", True), "rule 3, centre_y_m: must be a number, got true"),
    "nan": (lambda r: put(r, "consequents", math.nan), "rule 3, sigma: must lie between 0.1 and 1"),
    "inf": (lambda r: put(r, "centre", math.inf), "centre_y_m: must lie between -100 and 100, got"),
    "huge": (lambda r: put(r, "centre", 10**400), "rule 3, centre_y_m: must lie between"),
    "width": (lambda r: put(r, "width", 0.0), "rule 3, width_y_m: must lie between 0.001 and 3"),
    "wide": (lambda r: put(r, "width", 3.1), "rule 3, width_y_m: must lie between 0.001 and 3"),
    "degrees": (lambda r: put(r, "centre", 90, 2), "rule 3, centre_heading_rad: must lie between"),
    "mu": (lambda r: put(r, "consequents", 1.01, 0), "rule 3, mu: must lie between -1 and 1"),
    "sigma": (lambda r: put(r, "consequents", 0.05), "rule 3, sigma: must lie between 0.1 and 1"),
    "value": (lambda r: put(r, "consequents", 1e10, 2), "rule 3, value: must lie between -1e+09"),
    "deep": ("[" * 100_000, "nested too deeply"),
    "twice": ('{"format": "sofnn-torch rules", "version": 1, "version": 1', "not JSON"),
    "large": (" " * 3_000_000, "larger than"),
    "bytes": (b"\xff\xfe{\x00", "not a text file in UTF-8"),
}
BAD_CSV = {
    "empty": ("", "column centre_x_m is missing"),
    "binary": (b"\x89PNG\xff", "not a text file in UTF-8"),
    "semicolons": (lambda text: text.replace(",", ";"), "column centre_x_m is missing"),
    "column": (lambda text: text.replace("width_y_m", "width"), "column width_y_m is missing"),
    "twice": (lambda text: text.replace("rule", "mu", 1), "column mu is there twice"),
    "no rules": (lambda text: text.splitlines()[0], "0 rules, must be 1 to 60"),
    "cells": (lambda text: text + "1,2\n", "2 cells, the first line has"),
    "word": (
        lambda text: text.replace("0.06", "wide", 1),
        "rule 1, width_x_m: must be a number, got",
    ),
    "nan": (lambda text: text.replace("0.06", "nan", 1), "rule 1, width_x_m: must lie between"),
    "quote": (lambda text: text + '1,"2', "not CSV"),
}


def put(listed, field, value, place=1):
    listed[2][field][place] = value


@pytest.mark.parametrize(
    ("suffix", "name"),
    [*((".json", name) for name in BAD_JSON), *((".csv", name) for name in BAD_CSV)],
)
def test_a_bad_rule_file_gives_one_line_and_nothing_is_written(few, tmp_path, call, suffix, name):
    path, agent, *_ = few
    change, message = (BAD_JSON if suffix == ".json" else BAD_CSV)[name]
    file = written(agent, tmp_path / f"rules{suffix}")
    text = file.read_text()
    if isinstance(change, dict):
        change = json.dumps(json.loads(text) | change)
    elif callable(change) and suffix == ".json":
        data = json.loads(text)
        change(data["rules"])
        change = json.dumps(data)
    elif callable(change):
        change = change(text)
    file.write_bytes(change if isinstance(change, bytes) else change.encode())
    before = contents(path.parent)
    code, printed, error = call(path, "--load", file)
    assert code == 2 and not printed
    (line,) = error.splitlines()
    assert line.startswith(f"error: {file}: ") and message in line and len(line) < 300
    assert contents(path.parent) == before and len(list(tmp_path.iterdir())) == 1


def test_names_that_an_object_has_twice_are_refused(few, tmp_path):
    _, agent, *_ = few
    file = written(agent, tmp_path / "rules.json")
    text, kind = file.read_text(), files.schema(agent)
    file.write_text(text.replace('"usage"', '"width": [1, 1, 1], "usage"', 1))
    with pytest.raises(ValueError, match=r'rules.json: rule 1: "width" is there twice'):
        files.read(file, kind)
    file.write_text(text.replace('"version"', '"agent": "sga", "version"', 1))
    with pytest.raises(ValueError, match=r'rules.json: "agent" is there twice'):
        files.read(file, kind)


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


# ------------------------------------------------------------------------------------------ fuzz


@pytest.fixture(scope="module")
def few(tmp_path_factory):
    """A run with few rules: directory, learner, checkpoint, state, settings."""
    config = settings("sga", trials=1, net={"max_rules": 60}, maze={"max_steps": 40})
    path = training.train(config, quick_options(tmp_path_factory.mktemp("few"), name="run"))
    config, agent, file, state = evaluate.load(path)
    return path, agent, file, state, config


SLOW = [HealthCheck.too_slow, HealthCheck.data_too_large]  # the machine may be busy


class Accepted(Exception):
    """A rule file passed every check."""


JUNK = st.recursive(
    st.none()
    | st.booleans()
    | st.floats()
    | st.integers()
    | st.text(max_size=8)
    | st.sampled_from([10**400, -(10**60), 1e39, 3.5e38, 1e-50, -0.0, "NaN", "0.1", "sga"]),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=6,
)
SNIPPETS = st.sampled_from(
    [b"NaN", b"-Infinity", b"1e999", b"9" * 5000, b"-", b"\xff\xfe", b"\x00", b'"', b"\\", b"\n"]
    + [b",", b",,", b";", b"{", b"}", b"[", b"]", b"[" * 60_000, b'{"a":' * 20_000, b"\r", b"1_0"]
    + ["\u2028".encode(), "\ufeff".encode(), b'"rules": [],', b'"version": 1,', b"true", b"\\ud800"]
) | st.binary(max_size=6)


def places(data, path=()):
    """Paths to everything inside a JSON document."""
    inside = (
        data.items()
        if isinstance(data, dict)
        else enumerate(data)
        if isinstance(data, list)
        else ()
    )
    for key, value in inside:
        yield (*path, key)
        yield from places(value, (*path, key))


@st.composite
def broken_json(draw, text):
    data = json.loads(text)
    for _ in range(draw(st.integers(0, 3))):
        *parents, last = draw(st.sampled_from(list(places(data))))
        at = data
        for key in parents:
            at = at[key]
        what = draw(st.sampled_from(["replace", "replace", "drop", "number", "copy"]))
        if what == "drop":
            del at[last]
        elif what == "copy" and isinstance(at, list):
            at.insert(last, at[last])
        else:
            at[last] = draw(st.floats(-1.2, 1.2) if what == "number" else JUNK)
        if not data:
            break
    return json.dumps(data).encode()


@st.composite
def broken_csv(draw, text):
    lines = list(csv.reader(io.StringIO(text)))
    for _ in range(draw(st.integers(0, 3))):
        line = draw(st.sampled_from(lines))
        place = draw(st.integers(0, max(len(line) - 1, 0)))
        what = draw(st.sampled_from(["replace", "number", "drop", "insert", "line"]))
        if what == "line":
            lines.insert(draw(st.integers(0, len(lines))), list(line))
        elif what == "drop":
            del line[place : place + 1]
        else:
            cell = str(draw(st.floats(-1.2, 1.2) if what == "number" else JUNK))
            line[place : place + (what != "insert")] = [cell]
    made = io.StringIO()
    csv.writer(made).writerows(lines)
    return made.getvalue().encode(errors="surrogatepass")


@st.composite
def broken(draw, kind, text):
    """A rule file with changes to what it says, and to its bytes."""
    data = draw((broken_json if kind == ".json" else broken_csv)(text))
    for _ in range(draw(st.sampled_from([0, 0, 0, 1, 2]))):
        at = draw(st.integers(0, len(data)))
        what = draw(st.sampled_from(["cut", "insert", "overwrite", "repeat"]))
        if what == "cut":
            data = data[:at]
        elif what == "repeat":
            data = data[:at] + data[draw(st.integers(0, at)) :]
        else:
            piece = draw(SNIPPETS)
            data = data[:at] + piece + data[at + len(piece) * (what == "overwrite") :]
    return data


@pytest.mark.parametrize("suffix", [".json", ".csv"])
def test_broken_files_load_whole_or_not_at_all(few, tmp_path, monkeypatch, suffix):
    path, agent, file, state, config = few
    rule_file = tmp_path / f"rules{suffix}"
    text = written(agent, rule_file, parameters(agent)[:3]).read_text()
    before, outcomes = contents(path.parent), {"accepted": 0, "refused": 0}
    agent, kind = copy.deepcopy(agent), files.schema(agent)

    def create(*_):
        raise Accepted

    monkeypatch.setattr(rules.Run, "create", create)

    @trials_of(max_examples=1000, deadline=None, database=None, suppress_health_check=SLOW)
    @given(broken(suffix, text))
    def attempt(data):
        rule_file.write_bytes(data)
        options = rules.Options(run=path, load=rule_file)
        try:
            rules.edit(options, config, agent, file, state)
        except Accepted:
            outcomes["accepted"] += 1
            table = parameters(agent)
            assert ((kind.low <= table) & (table <= kind.high)).all()
            assert 1 <= agent.net.n_rules <= 60
            assert agent.act(STATES[0]) in (0, 1, 2)
        except ValueError as error:
            outcomes["refused"] += 1
            assert str(error).startswith(f"{rule_file}: ")
            assert len(str(error).splitlines()) == 1 and len(str(error)) < 400

    attempt()
    assert outcomes["accepted"] and outcomes["refused"] > 200, outcomes
    assert contents(path.parent) == before
    assert [p.name for p in tmp_path.iterdir()] == [rule_file.name]
