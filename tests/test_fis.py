"""Fuzzy systems in .fis files: as Octave evaluates them, read again, and rules of another tool."""

import dataclasses
import shutil
import subprocess

import numpy as np
import pytest
from exported import ALL, learner, states, turns_north
from test_export import command  # noqa: F401

from sofnn_torch.export import fis, policy, runtime, sugeno

OTHER = """% rules by hand: turn towards north, go straight there
[System]
Name='other tool'
Type='sugeno'
NumInputs=3
NumOutputs=1
NumRules=3
AndMethod='prod'
DefuzzMethod='wtaver'

[Input1]
Name='x'
Range=[0 1]
NumMFs=1
MF1='west':'gaussmf',[0.2 0]

[Input2]
Name='y'
Range=[0 1]
NumMFs=0

[Input3]
Name='heading'
Range=[-3.2 3.2]
NumMFs=2
MF1='east':'gaussmf',[0.5 0]
MF2='north':'gaussmf',[0.5 1.5708]

[Output1]
Name='steer'
Range=[-1 1]
NumMFs=2
MF1='left':'constant',[1]
MF2='straight':'constant',[0]

[Rules]
0 0 1, 1 (1) : 1
0 0 2, 2 (1) : 1
1 0 2, 2 (1) : 1
"""


@pytest.fixture
def other(tmp_path):
    """A file of another tool, and a policy whose axes and actions it is for."""
    (tmp_path / "other.fis").write_text(OTHER)
    (tmp_path / "like.json").write_bytes(policy.to_json(policy.describe(*learner("three"))))
    return tmp_path / "other.fis", tmp_path / "like.json"


@pytest.mark.parametrize("kind", ALL)
def test_a_written_system_concludes_as_the_policy_and_is_read_again(tmp_path, kind):
    config, agent = learner(kind)
    data, path = policy.describe(config, agent), tmp_path / "policy.fis"
    path.write_bytes(fis.to_fis(data))
    base, ours = fis.read(path), runtime.Policy(data)
    x = states(agent, 300).clip(ours.low, ours.high)
    x[:, ours.periods[: x.shape[1]] > 0] *= 0.9  # the seam is at the ends of the axis
    again = runtime.Policy(sugeno.as_policy(base, data))
    if data["decision"]["kind"] == "values":
        np.testing.assert_allclose(again.values(x), ours.values(x), atol=1e-6)
    else:
        np.testing.assert_allclose(means(again, x), means(ours, x), atol=1e-6)
        twins = base.outputs_at(x.astype(float))
        # Twins of rules as wide as these, up to 1.26 rad, add a little half a turn away.
        assert np.abs(twins - means(ours, x)).max() < 0.05


def test_rules_that_are_nearly_or_quite_the_same_stay_as_many(tmp_path):
    """Only a rule a whole turn away is the same: each counts in a normalised sum."""
    data = policy.describe(*learner("three"))
    base = sugeno.system(data)
    near = base.centres[:1] + [1e-7, 0, 0]
    more = dataclasses.replace(
        base,
        centres=np.vstack([base.centres, base.centres[:1], near]),
        widths=np.vstack([base.widths, base.widths[:1], base.widths[:1]]),
        slopes=np.vstack([base.slopes, base.slopes[:1], base.slopes[:1]]),
    )
    rules = sugeno.as_policy(more, data)["rules"]
    assert len(rules) == len(data["rules"]) + 2


def means(ours, x):
    return ours.outputs(x)[:, : ours.decision["numbers"]]


def test_rules_of_another_tool_come_in_and_drive(other, tmp_path, command):  # noqa: F811
    source, like = other
    code, out, error = command(source, "--like", like, "--to", tmp_path / "new.json")
    assert code == 0 and "3 rules" in out, error
    ours = turns_north(tmp_path / "new.json")
    far, at = np.array([0.9, 0.5, 0.2]), np.array([0.9, 0.5, 1.5])
    assert (ours.act(far), ours.act(at)) == (2, 1)


SPOILT = {
    "truncated": (lambda text: text[:300], "0 rules follow"),
    "empty": (lambda _: "", "'system' is missing"),
    "mamdani": (lambda text: text.replace("sugeno", "mamdani"), "type must be sugeno"),
    "min": (lambda text: text.replace("'prod'", "'min'"), "andmethod must be prod"),
    "a triangle": (lambda text: text.replace("gaussmf',[0.5 0]", "trimf',[0 1 2]"), "no Gaussian"),
    "a lost rule": (lambda text: text[: text.rindex("1 0 2")], "but 2 rules follow"),
    "a weight": (lambda text: text.replace("1 (1)", "1 (0.5)"), "only weight 1"),
    "an unknown set": (lambda text: text.replace("0 0 2,", "0 0 7,"), "no membership function 7"),
    "not": (lambda text: text.replace("0 0 2,", "0 0 -2,"), "rule 2"),
    "no number": (lambda text: text.replace("[0.2 0]", "[0.2 west]"), "west"),
    "a width of zero": (lambda text: text.replace("[0.2 0]", "[0 0]"), "must be positive"),
}


@pytest.mark.parametrize(("spoil", "said"), SPOILT.values(), ids=SPOILT.keys())
def test_what_the_rules_cannot_be_is_one_line(other, tmp_path, command, spoil, said):  # noqa: F811
    source, like = other
    source.write_text(spoil(OTHER))
    code, _, error = command(source, "--like", like, "--to", tmp_path / "new.json")
    assert code == 2 and error.count("\n") == 1 and said in error and str(source) in error


def test_a_system_needs_a_policy_that_says_what_it_is_for(other, tmp_path, command):  # noqa: F811
    code, _, error = command(other[0], "--to", tmp_path / "new.json")
    assert code == 2 and "--like RUN" in error


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("octave-cli"), reason="no octave-cli")
@pytest.mark.parametrize("kind", ["three", "q"])
def test_octave_computes_what_we_read(tmp_path, kind):
    """The fuzzy-logic-toolkit at 10,000 states."""
    config, agent = learner(kind, rules=10)
    (tmp_path / "policy.fis").write_bytes(fis.to_fis(policy.describe(config, agent)))
    base, x = fis.read(tmp_path / "policy.fis"), states(agent, 10_000).astype(float)
    low, high = np.array([ends for _, *ends in base.inputs]).T
    x = x.clip(low, high)
    np.savetxt(tmp_path / "x.txt", x, "%.17g")
    program = (
        "pkg load fuzzy-logic-toolkit; f = readfis('policy.fis'); x = load('x.txt');"
        "y = evalfis(x, f); save('-ascii', '-double', 'y.txt', 'y');"
    )
    # Some versions complain of themselves while they exit: what counts is the file.
    subprocess.run(["octave-cli", "--eval", program], cwd=tmp_path, capture_output=True)
    found = np.loadtxt(tmp_path / "y.txt").reshape(len(x), -1)
    np.testing.assert_allclose(found, base.outputs_at(x), atol=1e-6)
