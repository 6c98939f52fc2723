"""The examples do what they say: those in docstrings, and examples/."""

import doctest
import importlib
import pkgutil
import re
import runpy
from pathlib import Path

import pytest

from sofnn_torch import bounds, learners, network
from sofnn_torch.runs import settings

ROOT = Path(__file__).parents[1]
MODULES = [bounds, settings] + [
    importlib.import_module(found.name)
    for room in (network, learners)
    for found in pkgutil.iter_modules(room.__path__, f"{room.__name__}.")
]
EXAMPLES = [
    pytest.param(test, id=test.name)
    for module in MODULES
    for test in doctest.DocTestFinder(exclude_empty=True).find(module)
    if test.examples
]


@pytest.mark.parametrize("example", EXAMPLES)
def test_what_a_docstring_shows_is_so(example):
    assert doctest.DocTestRunner().run(example).failed == 0


def test_the_public_classes_show_how_they_are_used():
    shown = {example.id.rpartition(".")[2] for example in EXAMPLES}
    assert shown >= {"SOFNN", "Axis", "SGA", "QLearning", "Config", "bounds"}


def test_a_function_is_fitted_while_the_network_grows(capsys):
    runpy.run_path(str(ROOT / "examples" / "regression.py"), run_name="__main__")
    found = re.match(r"(\d+) rules, error (\S+) .*constant: (\S+)\n$", capsys.readouterr().out)
    rules, error, constant = map(float, found.groups())
    # Of sin(6 a) b: its mean square less the square of its mean, by integration.
    assert constant == pytest.approx(0.415, abs=0.01)
    assert error < 0.03
    assert 15 < rules < 60
