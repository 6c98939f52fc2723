"""The lab is one file that stands alone, and its policy decides as the learner does."""

import json
import os
import re
import shutil
import subprocess

import numpy as np
import pytest
from conftest import parameters
from exported import KINDS, learner, states
from own import Sarsa, SarsaConfig
from test_export import exported, margins

from sofnn_torch import evaluate
from sofnn_torch.learners.learner import Task
from sofnn_torch.maze.layouts import assets
from sofnn_torch.network.axes import named
from sofnn_torch.network.sofnn import SOFNN
from sofnn_torch.rules import lab, terms, words
from sofnn_torch.runs import rule_files
from sofnn_torch.runs.settings import Config

DATA = re.compile(r'<script type="application/json" id="data">(.*?)</script>', re.DOTALL)
CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), ""
)
NODE = shutil.which("node")
FLAGS = """--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-sync
    --disable-background-networking --disable-component-update --enable-logging=stderr --v=0
    --window-size=1400,1000""".split()
DECIDE = """
const found = states.map((x) => {
  const { choice, action, strongest } = decide(policy, x);
  return [choice, ...action];
});"""


def content(kind="three", **options):
    """Settings, learner and data of a page with rules by chance."""
    config, agent = learner(kind, **options)
    return config, agent, lab.data(config, agent, states(agent, 9), "chance", None, 0)


def page(kind="three", **options):
    """The text of a page with rules by chance."""
    return lab.filled(content(kind, **options)[2]).decode()


def test_a_page_of_1000_rules_is_one_small_file_without_any_reference():
    text = page(rules=1000)
    assert len(text.encode()) <= 1_000_000
    outside = DATA.sub("", text)
    assert not re.search(
        r"https?:|\bsrc=|\bhref=|url\(|@import|\bfetch\(|XMLHttp|WebSocket", outside
    )
    assert "default-src 'none'" in outside and "<style>" in outside


def test_the_rules_in_a_page_are_those_of_the_learner_to_the_last_bit():
    _, agent, _ = content(rules=200)
    data = json.loads(DATA.search(page(rules=200))[1])
    np.testing.assert_array_equal(np.array(data["rules"], np.float32), parameters(agent))
    assert data["head"] == rule_files.schema(agent).head


def test_no_name_ends_the_data_of_a_page():
    _, _, data = content(rules=3)
    data["name"] = "</script><script>alert(1)</script><!--"
    text = lab.filled(data).decode()
    assert json.loads(DATA.search(text)[1])["name"] == data["name"]
    assert text.count("alert(1)") == 1 and "<script>alert" not in text


def test_the_trial_in_which_a_rule_was_made_is_known_from_the_counts():
    assert lab.born([2, 2, 3, 5], 5) == [1, 1, 3, 4, 4]


@pytest.mark.parametrize("counts", [[], [2, 3], [4, 3, 5], [2, None, 5]])
def test_after_edits_nobody_says_when_a_rule_was_made(counts):
    assert lab.born(counts, 5) == []


def test_the_command_writes_a_page_with_the_trials_of_the_run(call, few, tmp_path):
    file = tmp_path / "lab.html"
    code, out, _ = call(few[0], "--html", file)
    assert code == 0 and f"written: {file}" in out
    data = json.loads(DATA.search(file.read_text())[1])
    assert data["name"] == "run" and data["curves"]["steps"] == [40] and set(data["born"]) == {1}
    np.testing.assert_array_equal(np.array(data["rules"], np.float32), parameters(few[1]))


def test_a_page_needs_the_ending_html(call, few, tmp_path):
    code, _, error = call(few[0], "--html", tmp_path / "lab.txt")
    assert code == 2 and "--html must end in .html" in error


def test_a_learner_that_does_not_say_how_it_decides_has_no_page():
    task = Task(named(2), ("left", "right"), discrete=True)
    agent = Sarsa(SOFNN(2, 2, width=0.2), task, SarsaConfig())
    with pytest.raises(ValueError, match="has no decoding"):
        lab.data(Config(), agent, np.zeros((1, 2), np.float32), "own", None, 0)


def check_decisions(kind, agent, config, x, found):
    """Choices and actions of the page are those of the exported policy and of the learner."""
    ours = exported(config, agent)
    plan = agent.plan(np.clip(x, ours.low, ours.high).astype(np.float32))  # as the task gives them
    close = margins(ours, x)
    if agent.choices:
        choices = np.array([choice for choice, *_ in found])
        theirs = ours.values(x).argmax(1) if ours.decision["kind"] == "values" else plan.choice
        exact = np.array([ours.act(state) for state in x]) if ours.discrete else theirs
        assert ((choices == exact) | (close < 1e-9)).all(), kind
        assert ((choices == plan.choice) | (close < 1e-5)).all(), kind
    else:
        actions = np.array([action for _, *action in found])
        np.testing.assert_allclose(actions, plan.actions, atol=1e-5)
        np.testing.assert_allclose(actions, [ours.act(state) for state in x], atol=1e-7)


@pytest.mark.skipif(not NODE, reason="needs node")
@pytest.mark.parametrize("kind", ["three", "q antecedent", "pendulum"])
def test_the_policy_of_a_page_decides_as_the_learner(kind):
    config, agent, data = content(kind)
    x = states(agent, 300)
    home = assets() / "lab"
    parts = [
        (home / name).read_text() for name in ("policy.js", "robot.js", "words.js", "field.js")
    ]
    known = f"const data = {json.dumps(data)}, states = {x.tolist()}, task = data.task;"
    rules = """const n = task.inputs.length, rules = data.rules.map((row, k) => ({ number: k + 1,
        centre: row.slice(0, n), width: row.slice(n, 2 * n), consequents: row.slice(2 * n) }));
        const policy = makePolicy(task, rules);"""
    field = """
    const told = states.map((x) => reason(policy, decide(policy, x)));
    const sums = states.map((x) => { const d = decide(policy, x);
      return d.margin === null ? 0 : d.support.reduce((a, b) => a + b, 0) - d.margin; });
    const field = (policy, x) => {
      const field = makeField(policy, 0, 1, [x[0], x[0] + 0.02], [x[1]]);
      sumField(field, x);
      return field;
    };
    const at = states.slice(0, 12).map((x) => [readField(field(policy, x)).leanings[0],
      leaning(policy, decide(policy, x))]);
    const changed = (k) => ({ ...rules[k], centre: rules[k].centre.map((v) => 0.98 * v),
      consequents: rules[k].consequents.map((v) => v + 0.1) });
    const others = rules.map((rule, k) => (k % 9 ? rule : changed(k)));
    const other = makePolicy(task, others), moved = states.slice(0, 12).map((x) => {
      const swapped = field(policy, x);
      swapRules(swapped, other, [...rules.keys()].filter((k) => k % 9 === 0));
      const both = [readField(swapped), readField(field(other, x))];
      return both.map((f) => [...f.leanings, ...f.values]);
    });
    console.log(JSON.stringify({ found, told, sums, at, moved,
      places: rules.map(whereOf) }));"""
    program = "\n".join([*parts, known, rules, DECIDE, field])
    done = subprocess.run([NODE, "-"], input=program, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    answers = json.loads(done.stdout)
    check_decisions(kind, agent, config, x, answers["found"])
    np.testing.assert_allclose(answers["sums"], 0, atol=1e-9)  # voices add up to the margin
    drawn, decided = np.array(answers["at"]).T
    np.testing.assert_allclose(drawn, decided, atol=1e-3)
    swapped, anew = np.array(answers["moved"]).transpose(1, 0, 2)
    np.testing.assert_allclose(swapped, anew, rtol=1e-5, atol=1e-5)
    assert all(text.endswith(".") and "NaN" not in text for text in answers["told"])
    sentences = terms.sentences(agent, words.read(agent), lab.TERMS)
    for ours, theirs in zip(answers["places"], sentences, strict=True):
        assert theirs.lower().startswith(f"{ours}:")


# ------------------------------------------------------------------------------- in a browser

browser = pytest.mark.skipif(not CHROMIUM, reason="needs Chromium: apt install chromium")


def browse(text, script, folder, patience=4000):
    """What a script appended to a page leaves in `result`, and the messages of the console."""
    file = folder / "page.html"
    show = """const shown = document.createElement("pre"); shown.id = "result";
        shown.textContent = JSON.stringify(result); document.body.append(shown);"""
    end = text.rindex("</body>")
    file.write_text(f"{text[:end]}<script>{{ {script}\n{show} }}</script>{text[end:]}")
    home = folder / "browser"
    done = subprocess.run(
        [CHROMIUM, *FLAGS, f"--user-data-dir={home}", "--dump-dom", file.as_uri()],
        capture_output=True,
        text=True,
        timeout=300,
        env=os.environ | {"HOME": str(folder)},
    )
    found = re.search(r'<pre id="result">(.*?)</pre>', done.stdout, re.DOTALL)
    messages = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert found, f"{messages} {done.stderr[-2000:]}"
    plain = found[1].replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")
    return json.loads(plain), messages


@pytest.mark.slow
@browser
@pytest.mark.parametrize("kind", KINDS)
def test_in_a_browser_10000_decisions_are_those_of_the_learner_without_a_complaint(kind, tmp_path):
    config, agent, data = content(kind)
    x = states(agent, 10_000)
    script = f"const states = {x.tolist()}; {DECIDE} const result = found;"
    found, messages = browse(lab.filled(data).decode(), script, tmp_path)
    assert messages == []
    check_decisions(kind, agent, config, x, found)


PLAY = """
const send = (id, kind, more) => $(id).dispatchEvent(new Event(kind, { bubbles: true, ...more }));
const type = (key, more) => $("map").dispatchEvent(
  new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true, ...more }));
const untouched = ruleFile();
const box = $("map").getBoundingClientRect();
const point = (kind, x, y) => $("map").dispatchEvent(new PointerEvent(kind, {
  clientX: box.left + x, clientY: box.top + y, pointerId: 1, pointerType: "mouse",
  bubbles: true }));
$("map").setPointerCapture = () => {};
choose(2);
const [x, y] = handles(chosen()).centre, before = [...chosen().centre];
point("pointerdown", x, y);
for (const kind of ["pointermove", "pointerup"]) point(kind, x + 30, y - 20);
const dragged = [...chosen().centre];
const input = $("editor").querySelector('input[type=number][data-key="consequents-0"]');
input.value = "0.75";
input.dispatchEvent(new Event("input", { bubbles: true }));
input.dispatchEvent(new Event("change", { bubbles: true }));
const voted = chosen().consequents[0];
type("Delete");
const left = rules.length;
undo();
const saved = ruleFile(), steps = past.length;
undo(); undo();
const undone = ruleFile() === untouched;
undo(future, past); undo(future, past);
const redone = ruleFile() === saved;
const there = [...view.pose];
type("ArrowRight"); type("]"); type("Enter");
const moved = [view.pose[0] - there[0], view.pose[2] - there[2], view.chosen === null];
$("search").value = "3"; send("search", "input");
const listed = $("rules").tBodies[0].rows.length;
$("search").value = ""; send("search", "input");
$("rules").querySelector('button[data-sort="number"]').click();
const sorted = $("rules").tBodies[0].rows[0].cells[0].textContent;
for (const field of ["value", "none", "action"]) {
  $("field").value = field;
  send("field", "change");
}
toTrial(0); const none = listedRules().length; toTrial(data.trial);
driving = { steps: 0, left: 0, speeds: null, decisions: 0 };
maze.most = 3000;
let end = ""; while (!end) end = oneStep(); driving = null;
const free = view.trail.every(([x, y]) => clearance(maze, x, y) > -1e-9);
const result = { untouched, saved, before, dragged, voted, left, steps, undone, redone, moved,
  listed, sorted, none, free, way: view.trail.length };
"""


@pytest.mark.slow
@browser
def test_rules_are_changed_undone_saved_and_loaded_as_a_run(call, few, tmp_path):
    file = tmp_path / "lab.html"
    call(few[0], "--html", file)
    found, messages = browse(file.read_text(), PLAY, tmp_path)
    assert messages == []
    count = few[1].net.n_rules
    assert found["left"] == count - 1 and found["steps"] == 2 and found["voted"] == 0.75
    assert found["dragged"][0] > found["before"][0] and found["dragged"][1] > found["before"][1]
    assert found["undone"] and found["redone"] and not found["moved"][2]
    np.testing.assert_allclose(found["moved"][:2], [0.01, -np.pi / 36])
    assert (found["listed"], found["sorted"], found["none"]) == (1, "1", 0)
    assert found["free"] and found["way"] > 100
    for name, text in (("same", found["untouched"]), ("other", found["saved"])):
        (tmp_path / f"{name}.json").write_text(text)
        home = tmp_path / "run"
        if not home.exists():
            shutil.copytree(few[0], home)
        code, _, error = call(home, "--load", tmp_path / f"{name}.json", "--name", name)
        assert code == 0, error
    same, other = (parameters(evaluate.load(tmp_path / name).agent) for name in ("same", "other"))
    np.testing.assert_array_equal(same, parameters(few[1]))
    changed = np.argwhere(same != other)
    assert set(changed[:, 0]) == {1} and set(changed[:, 1]) == {0, 1, 6}
    np.testing.assert_allclose(other[1, :2], found["dragged"][:2], rtol=1e-6)
    assert other[1, 6] == 0.75


@pytest.mark.slow
@browser
@pytest.mark.parametrize("kind", ["q antecedent", "wheels", "pole q", "pendulum", "sheet"])
def test_pages_of_every_kind_can_be_changed_without_a_complaint(kind, tmp_path):
    script = """choose(1);
        for (const input of $("editor").querySelectorAll("input[type=number]")) {
          input.value = Number(input.value) * 1.01;
          input.dispatchEvent(new Event("input", { bubbles: true }));
        }
        for (const head of [...document.querySelectorAll("#rules th button")]) {
          $("rules").querySelector(`button[data-sort="${head.dataset.sort}"]`).click(); }
        copyHere(); $("visit").click(); removeChosen();
        const said = document.body.innerText;
        const result = [rules.length, past.length > 2, said.includes("NaN")];"""
    found, messages = browse(page(kind), script, tmp_path)
    assert messages == [] and found == [40, True, False]
