"""The help: short and whole, at any width, in words."""

import dataclasses
import re

import pytest

from sofnn_torch import cli, evaluate, help, plot, terminal
from sofnn_torch.export.__main__ import Options as Export
from sofnn_torch.maze.optimum import Options as Optimum
from sofnn_torch.rules.__main__ import Options as Rules
from sofnn_torch.runs.session import RunOptions
from sofnn_torch.runs.settings import Config
from sofnn_torch.studies.__main__ import Options as Studies

KINDS = [cli.Flags, evaluate.Options, plot.Options, Export, Optimum, Rules, Studies]
TRAIN = cli.Flags(Config(), RunOptions())


def lines(kind, monkeypatch, width, **how):
    monkeypatch.setenv("COLUMNS", str(width))
    default = TRAIN if kind is cli.Flags else None
    return help.text(kind, "program", "What it does.", default, **how).splitlines()


@pytest.mark.parametrize("width", [60, 80, 111, 200])
@pytest.mark.parametrize("kind", KINDS)
def test_it_fits_into_the_terminal_and_fills_it(kind, width, monkeypatch):
    shown = lines(kind, monkeypatch, width)
    assert max(map(len, shown)) <= width
    text = [line for line in shown if line.startswith(" " * 10)]
    if len(text) > 20:  # a paragraph is broken where the terminal ends, not where the source does
        assert max(map(len, text)) > 0.85 * min(width, 120)


@pytest.mark.parametrize("kind", KINDS)
def test_types_are_said_in_words(kind, monkeypatch):
    shown = "\n".join(lines(kind, monkeypatch, 100))
    assert not re.search(r"\{|\}|None\||\|None|VALUE|<class|typing|MISSING", shown)
    assert not re.search(r"\[(?!OPTIONS)", shown)


@pytest.mark.parametrize("kind", KINDS)
def test_a_wrong_value_of_any_kind_is_answered_in_words(kind):
    default = TRAIN if kind is cli.Flags else None
    names = {flag.usage.partition(" ")[2]: flag.name for flag in help._flags(kind, default)}
    for name in names.values():
        try:
            terminal.parse(kind, ["RUN", f"--{name}", "0.1,", "x"], "", default)
        except ValueError as error:
            said = str(error)
            assert not re.search(r"FLOAT|\bINT\b|\[|\{|Error parsing|NoneType|class", said), said


@pytest.mark.parametrize("kind", KINDS)
def test_every_flag_is_explained(kind):
    flags = list(help._flags(kind, TRAIN if kind is cli.Flags else None))
    assert [flag.name for flag in flags if len(flag.text) < 8] == []
    own = [f.name for f in dataclasses.fields(kind) if f.name not in ("config", "options")]
    assert {name.replace("_", "-") for name in own} <= {flag.name for flag in flags}


def test_the_short_help_shows_a_dozen_flags_or_so(monkeypatch, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.parse(["--help"])
    assert stop.value.code == 0
    shown = re.findall(r"^  (?:-h, )?(--[\w.-]+)", capsys.readouterr().out, re.MULTILINE)
    assert set(shown) == {f"--{name}" for name in cli.MOST_USED} | {"--help", "--help-all"}
    assert len(shown) <= 17


def test_the_whole_help_has_groups(monkeypatch):
    shown = lines(cli.Flags, monkeypatch, 90)
    groups = [line for line in shown if line.endswith(":") and not line.startswith(" ")]
    assert groups == [
        "options:",
        "Section 2: the fuzzy network:",
        "Section 3: stochastic gradient ascent:",
        "Section 4: Q-learning:",
        "Section 5: robot and maze:",
    ]
    assert any(line.startswith("  --net.theta NUMBER") for line in shown)


def test_a_flag_of_two_forms_shows_the_one_that_changes_something(monkeypatch):
    shown = "\n".join(lines(cli.Flags, monkeypatch, 100))
    assert "--sga.variance-scaled, --sga.no-variance-scaled" in shown
    assert "--quiet " in shown and "--no-quiet" not in shown


def test_a_command_without_a_short_help_says_so(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["plot", "--help-all"])
    with pytest.raises(SystemExit) as stop:
        plot.main()
    assert stop.value.code == 2
    assert "--help-all" in capsys.readouterr().err
