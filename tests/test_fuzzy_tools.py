"""Fuzzy systems in FML and FCL: as other tools evaluate them, read again, and rules of others."""

import os
import shutil
import subprocess

import numpy as np
import pytest
from exported import ALL, learner, states, turns_north
from test_export import command  # noqa: F401
from test_fis import means

from sofnn_torch.export import fcl, fml, policy, runtime, sugeno

FORMS = {"fml": (fml.to_fml, fml.read), "fcl": (fcl.to_fcl, fcl.read)}

FCL = """(* rules by hand: turn towards north,
   go straight there *)
FUNCTION_BLOCK Other
VAR_INPUT
    x : REAL; y : REAL;
    heading : REAL;
END_VAR
VAR_OUTPUT
    steer : REAL;
END_VAR
FUZZIFY x
    TERM west := gauss 0 0.2;  // as jFuzzyLogic writes it
END_FUZZIFY
FUZZIFY y
    RANGE := (0.0 .. 1.0);
END_FUZZIFY
FUZZIFY heading
    RANGE := (-3.2 .. 3.2);
    TERM east := Gaussian 0 0.5;
    TERM north := Gaussian 1.5708 0.5;
END_FUZZIFY
DEFUZZIFY steer
    TERM left := 1;
    TERM straight := Constant 0;
    METHOD : COGS;
    DEFAULT := 0;
END_DEFUZZIFY
RULEBLOCK one
    AND : PROD;
    ACT : MIN;
    RULE 1 : IF heading IS east THEN steer IS left;
    RULE 2 : if heading is north then steer is straight
    RULE three : IF (x IS west) AND (heading IS north)
        THEN steer IS straight WITH 1.0;
END_RULEBLOCK
END_FUNCTION_BLOCK
"""
FML = """<?xml version="1.0" encoding="UTF-8" standalone="yes"?>
<fuzzySystem xmlns="http://www.ieee1855.org" name="other">
  <knowledgeBase>
    <fuzzyVariable name="x" domainleft="0" domainright="1" type="input" scale="m">
      <fuzzyTerm name="west" complement="false"><gaussianShape param1="0" param2="0.2"/></fuzzyTerm>
    </fuzzyVariable>
    <fuzzyVariable name="y" domainleft="0" domainright="1"/>
    <fuzzyVariable name="heading" domainleft="-3.2" domainright="3.2" type="input">
      <fuzzyTerm name="east"><gaussianShape param1="0" param2="0.5"/></fuzzyTerm>
      <fuzzyTerm name="north"><gaussianShape param1="1.5708" param2="0.5"/></fuzzyTerm>
    </fuzzyVariable>
    <tskVariable name="steer" type="output" combination="WA">
      <tskTerm name="left" order="0"><tskValue>1</tskValue></tskTerm>
      <tskTerm name="straight" order="1"><tskValue>0</tskValue><tskValue>0</tskValue>
        <tskValue>0</tskValue><tskValue>0</tskValue></tskTerm>
    </tskVariable>
  </knowledgeBase>
  <tskRuleBase name="rules" andMethod="PROD">
    <tskRule name="one"><antecedent>
      <clause><variable>heading</variable><term>east</term></clause></antecedent>
      <tskConsequent><tskThen><tskClause><variable>steer</variable><term>left</term></tskClause>
      </tskThen></tskConsequent></tskRule>
    <tskRule name="two" weight="1.0"><antecedent>
      <clause><variable>heading</variable><term>north</term></clause></antecedent>
      <tskConsequent><tskThen><tskClause><variable>steer</variable><term>straight</term></tskClause>
      </tskThen></tskConsequent></tskRule>
    <tskRule name="three" connector="and"><antecedent>
      <clause><variable>x</variable><term>west</term></clause>
      <clause><variable>heading</variable><term>north</term></clause></antecedent>
      <tskConsequent><tskThen><tskClause><variable>steer</variable><term>straight</term></tskClause>
      </tskThen></tskConsequent></tskRule>
  </tskRuleBase>
</fuzzySystem>
"""
OTHERS = {"fcl": FCL, "fml": FML}


@pytest.fixture
def like(tmp_path):
    """A policy whose axes and actions rules are for."""
    path = tmp_path / "like.json"
    path.write_bytes(policy.to_json(policy.describe(*learner("three"))))
    return path


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", ALL)
def test_a_written_system_is_the_policy_and_is_read_again(tmp_path, kind, form):
    write, read = FORMS[form]
    config, agent = learner(kind)
    data, path = policy.describe(config, agent), tmp_path / f"policy.{form}"
    path.write_bytes(write(data))
    base, found = sugeno.system(data), read(path)
    for part in ("centres", "widths", "slopes"):
        np.testing.assert_array_equal(getattr(found, part), getattr(base, part))
    assert [ends for _, *ends in found.inputs] == [ends for _, *ends in base.inputs]
    ours, again = runtime.Policy(data), runtime.Policy(sugeno.as_policy(found, data))
    x = states(agent, 300).clip(ours.low, ours.high)
    x[:, ours.periods[: x.shape[1]] > 0] *= 0.9  # the seam is at the ends of the axis
    compared = means if data["decision"]["kind"] == "normal" else runtime.Policy.values
    np.testing.assert_allclose(compared(again, x), compared(ours, x), atol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_rules_of_another_tool_come_in_and_drive(tmp_path, form, like, command):  # noqa: F811
    source = tmp_path / f"other.{form}"
    source.write_text(OTHERS[form])
    code, out, error = command(source, "--like", like, "--to", tmp_path / "new.json")
    assert code == 0 and "3 rules" in out, error
    turns_north(tmp_path / "new.json")


def test_names_of_tasks_are_made_words_of_the_languages():
    assert sugeno.identifiers(["x [m]", "x (m)", "is", "1", "And"]) == [
        "x_m_",
        "x_m__",
        "_is",
        "_1",
        "_And",
    ]


def swap(old, new):
    def change(text):
        assert old in text
        return text.replace(old, new)

    return change


def lost(start, end):
    return lambda text: text[: text.index(start)] + text[text.index(end) :]


SPOILT = {
    "fcl": {
        "truncated": (lambda text: text[:700], "END_FUNCTION_BLOCK is missing"),
        "empty": (lambda _: "", "not an FCL file, or not all of it"),
        "a lost block": (lost("DEFUZZIFY", "RULEBLOCK"), "'steer') is missing"),
        "no end": (swap("END_FUZZIFY\nFUZZIFY y", "FUZZIFY y"), "'FUZZIFY y' is no Gaussian"),
        "a triangle": (swap("gauss 0 0.2", "trian -1 0 1"), "is no Gaussian set"),
        "points": (swap("gauss 0 0.2", "(0, 1) (1, 0)"), "is no Gaussian set"),
        "min": (swap("AND : PROD", "AND : MIN"), "AND must be PROD"),
        "another method": (swap("COGS", "COG"), "METHOD must be COGS"),
        "a sum that is none": (swap("METHOD", "ACCU : MAX;\nMETHOD"), "ACCU joins rules"),
        "a weight": (swap("WITH 1.0", "WITH 0.5"), "no rule of weight 1"),
        "or": (swap("west) AND", "west) OR"), "no set of a variable there"),
        "not": (swap("IF heading IS east", "IF heading IS NOT east"), "no set of a variable"),
        "an unknown set": (swap("IS east", "IS south"), "no membership function 'south'"),
        "an unknown name": (swap("IF heading IS east", "IF head IS east"), "no set of a variable"),
        "no number": (swap("gauss 0 0.2", "gauss 0 wide"), "wide"),
        "a width of zero": (swap("gauss 0 0.2", "gauss 0 0"), "must be positive"),
        "no rules": (lost("    RULE 1", "END_RULEBLOCK"), "1 to 100,000 rules"),
        "other inputs": (
            lambda text: text.replace("y : REAL;", "").replace("FUZZIFY y", "FUZZIFY z"),
            "FUZZIFY z is of no variable",
        ),
    },
    "fml": {
        "truncated": (lambda text: text[:1500], "not XML, or not all of it"),
        "empty": (lambda _: "", "not XML, or not all of it"),
        "another document": (lambda _: "<a/>", "needs a fuzzySystem"),
        "mamdani": (swap("tskRuleBase", "mamdaniRuleBase"), "Mamdani"),
        "entities": (
            swap("<fuzzySystem", "<!DOCTYPE a [<!ENTITY b 'c'>]><fuzzySystem"),
            "entities",
        ),
        "a triangle": (swap("gaussianShape param1", "triangularShape param1"), "is no Gaussian"),
        "a complement": (swap('complement="false"', 'complement="true"'), "is no Gaussian"),
        "min": (swap(' andMethod="PROD"', ""), "andMethod PROD"),
        "or": (swap('connector="and"', 'connector="or"'), "joined by and"),
        "a weight": (swap('weight="1.0"', 'weight="0.5"'), "only weight 1"),
        "a hedge": (swap("<clause>", '<clause modifier="very">'), "modified"),
        "an unknown set": (swap("<term>east", "<term>south"), "no membership function 'south'"),
        "an unknown name": (swap("<variable>x<", "<variable>z<"), "'z' is no variable"),
        "no number": (swap('param2="0.2"', 'param2="wide"'), "wide"),
        "a width of zero": (swap('param2="0.2"', 'param2="0"'), "must be positive"),
        "a lost width": (swap(' param2="0.2"', ""), "'param2' is missing"),
        "a short term": (swap("<tskValue>0</tskValue></tskTerm>", "</tskTerm>"), "4 finite"),
        "another order": (swap('order="1"', 'order="2"'), "order must be 0"),
        "no conclusion": (swap("straight</term></tskClause>", "</term></tskClause>"), "function"),
        "no output": (swap(' type="output"', ""), "'domainleft' is missing"),
    },
}
CASES = [
    pytest.param(form, *case, id=f"{form}: {name}")
    for form, cases in SPOILT.items()
    for name, case in cases.items()
]


@pytest.mark.parametrize(("form", "spoil", "said"), CASES)
def test_what_the_rules_cannot_be_is_one_line(tmp_path, like, command, form, spoil, said):  # noqa: F811
    source = tmp_path / f"other.{form}"
    source.write_text(spoil(OTHERS[form]))
    code, _, error = command(source, "--like", like, "--to", tmp_path / "new.json")
    assert code == 2 and error.count("\n") == 1 and said in error and str(source) in error


# --------------------------------------------------------------------------- the tools themselves


def asked(tmp_path, kind, form, rules=40):
    """A file of a policy, what it must conclude at 10,000 states, and these."""
    config, agent = learner(kind, rules=rules)
    path = tmp_path / f"policy.{form}"
    path.write_bytes(FORMS[form][0](policy.describe(config, agent)))
    base = FORMS[form][1](path)
    low, high = np.array([ends for _, *ends in base.inputs]).T
    x = states(agent, 10_000).astype(float).clip(low, high)
    np.savetxt(tmp_path / "x.txt", x, "%.17g")
    return path, base.outputs_at(x), x


FUZZYLITE = """
#include <fl/Headers.h>
#include <cstdio>
#include <iostream>
int main(int, char **argv) {
    fl::fuzzylite::setMachEps(0); // or rules that fire less than 1e-6 are left out
    fl::Engine *engine = fl::FclImporter().fromFile(argv[1]);
    double value;
    for (std::size_t i = 0; std::cin >> value;) {
        engine->getInputVariable(i++)->setValue(value);
        if (i < engine->numberOfInputVariables()) continue;
        engine->process();
        for (std::size_t j = 0; j < engine->numberOfOutputVariables(); j++)
            std::printf("%.17g\\n", engine->getOutputVariable(j)->getValue());
        i = 0;
    }
}
"""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["three", "q", "wheels", "pendulum"])
def test_fuzzylite_computes_what_we_read_in_fcl(tmp_path, kind):
    """The C++ library, where a compiler finds it (CPATH and LIBRARY_PATH may say where)."""
    (tmp_path / "main.cpp").write_text(FUZZYLITE)
    build = ["g++", "-std=c++11", "-w", "main.cpp", "-o", "main", "-lfuzzylite"]
    if (
        not shutil.which("g++")
        or subprocess.run(build, cwd=tmp_path, capture_output=True).returncode
    ):
        pytest.skip("no g++ with fuzzylite")
    path, expected, _ = asked(tmp_path, kind, "fcl")
    with open(tmp_path / "x.txt") as lines:
        call = [tmp_path / "main", path]
        done = subprocess.run(call, stdin=lines, check=True, capture_output=True, text=True)
    found = np.array(done.stdout.split(), float).reshape(expected.shape)
    np.testing.assert_allclose(found, expected, atol=1e-6)


PYFUZZYLITE = """
import re, sys
import fuzzylite as fl, numpy as np
lines = ["Engine: policy"]
for line in open(sys.argv[1]):
    word, *words = line.strip().rstrip(";").split()[:2] or [""]
    rest = line.strip().rstrip(";").partition(":")[2].removeprefix("= ").strip()
    if word == "FUZZIFY":
        lines.append("InputVariable: " + words[0])
    elif word == "DEFUZZIFY":
        lines += ["OutputVariable: " + words[0], "defuzzifier: WeightedAverage TakagiSugeno"]
    elif word == "RULEBLOCK":
        lines += ["RuleBlock: rules", "conjunction: AlgebraicProduct", "activation: General"]
    elif word == "RANGE":
        lines.append("range: " + rest.strip("()").replace(" .. ", " "))
    elif word == "TERM":
        lines.append(f"term: {words[0]} " + (rest if rest[0].isalpha() else "Constant " + rest))
    elif word == "RULE":
        lines.append("rule: " + rest)
fl.settings.decimals = 17
engine = fl.FllImporter().from_string("\\n".join(lines))
engine.input_values = np.loadtxt("x.txt")
engine.process()
np.savetxt("y.txt", engine.output_values, "%.17g")
"""


@pytest.mark.slow
@pytest.mark.skipif("PYFUZZYLITE" not in os.environ, reason="no Python in $PYFUZZYLITE")
@pytest.mark.parametrize("kind", ["three", "q", "pendulum"])
def test_pyfuzzylite_computes_what_we_wrote_in_fcl(tmp_path, kind):
    """It reads its own language only: terms and rules are those of the file, the frame differs."""
    path, expected, _ = asked(tmp_path, kind, "fcl")
    (tmp_path / "run.py").write_text(PYFUZZYLITE)
    call = [os.environ["PYFUZZYLITE"], "run.py", path]
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(call, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = np.loadtxt(tmp_path / "y.txt").reshape(expected.shape)
    np.testing.assert_allclose(found, expected, atol=1e-6)


JFML = """
import java.io.*;
import java.util.*;
import jfml.*;
public class Main {
    public static void main(String[] a) throws Exception {
        FuzzyInferenceSystem system = JFML.load(new File(a[0]));
        Scanner in = new Scanner(new File("x.txt"));
        PrintWriter out = new PrintWriter("y.txt");
        List<jfml.knowledgebase.variable.KnowledgeBaseVariable> all = system.getVariables();
        while (in.hasNext()) {
            for (jfml.knowledgebase.variable.KnowledgeBaseVariable v : all)
                if (v.isInput()) v.setValue(Float.parseFloat(in.next()));
            system.evaluate();
            for (jfml.knowledgebase.variable.KnowledgeBaseVariable v : all)
                if (v.isOutput()) out.println(v.getValue());
        }
        out.close();
    }
}
"""


@pytest.mark.slow
@pytest.mark.skipif("JFML" not in os.environ, reason="no JFML.jar in $JFML")
@pytest.mark.parametrize("kind", ["three", "q", "wheels", "pendulum"])
def test_jfml_computes_what_we_read_in_fml(tmp_path, kind):
    """The reference library of IEEE 1855, in Java and single precision."""
    path, expected, _ = asked(tmp_path, kind, "fml")
    (tmp_path / "Main.java").write_text(JFML)
    jar = ["-cp", os.environ["JFML"]]
    done = subprocess.run(["java", *jar, "Main.java", path], cwd=tmp_path, capture_output=True)
    assert done.returncode == 0, done.stderr
    found = np.loadtxt(tmp_path / "y.txt").reshape(expected.shape)
    assert np.abs(found - expected).max() < 1e-6 * max(1.0, np.abs(expected).max())
