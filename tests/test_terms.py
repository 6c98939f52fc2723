"""Rules as sentences: the terms are the nearest ones, the order is that of the way."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import written
from exported import learner

from sofnn_torch.network.axes import Axis
from sofnn_torch.rules import played, tables, terms, words
from sofnn_torch.runs import rule_files
from sofnn_torch.runs.factory import make_agent
from sofnn_torch.runs.settings import Config

X, Y = Axis("x", "m", 0, 1), Axis("y", "m", 0, 1)
HEADING = Axis("heading", "rad", -math.pi, math.pi, period=2 * math.pi)
CAR = Axis("position", "", -1.2, 0.6)
RULES = Path(__file__).parents[1] / "examples" / "rules" / "sga.csv"


@pytest.fixture
def ten():
    """A learner with the ten rules that were written by hand."""
    agent = make_agent(Config())
    table = torch.from_numpy(rule_files.read(RULES, rule_files.schema(agent)))
    agent.net.replace_rules(*table.split_with_sizes(agent.net.parts, 1))
    return agent


@pytest.mark.parametrize("count", range(2, 8))
@pytest.mark.parametrize("axis", [X, CAR, HEADING, Axis("speed", "m/s", -2, 2)])
def test_a_narrow_rule_is_about_the_term_whose_middle_is_nearest(axis, count):
    found = terms.terms(axis, count)
    assert len(set(found.names)) == len(found.names) == (8 if axis.period else count)
    parts = len(found.names)
    low, step = (
        (-math.pi / 8, math.pi / 4) if axis.period else (axis.low, (axis.high - axis.low) / count)
    )
    middles = [low + (i + 0.5) * step for i in range(parts)]
    for centre in np.random.default_rng(count).uniform(axis.low - 0.5, axis.high + 0.5, 200):
        far = [abs(centre - middle) for middle in middles]
        if axis.period:
            far = [abs(math.remainder(centre - middle, axis.period)) for middle in middles]
        assert found.of(centre, 1e-3) == found.names[far.index(min(far))]


@pytest.mark.parametrize("axis", [X, HEADING])
def test_a_wide_rule_is_also_about_the_terms_in_whose_middle_it_fires_by_a_half(axis):
    found, rng = terms.terms(axis, 5), np.random.default_rng(0)
    parts = len(found.names)
    for centre, width in rng.uniform([axis.low, 0.02], [axis.high, 2], (300, 2)):
        middles = [found.low + found.step * (i + 0.5) for i in range(parts)]
        away = [m - centre for m in middles]
        if axis.period:
            away = [math.remainder(d, axis.period) for d in away]
        about = [math.exp(-0.5 * (d / width) ** 2) >= 0.5 for d in away]
        about[int(np.argmin(np.abs(away)))] = True
        said = found.of(centre, width)
        if all(about):
            assert said == ""
            continue
        ordered = [i for i in sorted(range(parts), key=away.__getitem__) if about[i]]
        first, last = found.names[ordered[0]], found.names[ordered[-1]]
        assert said == (first if len(ordered) == 1 else f"{first} to {last}")


@pytest.mark.parametrize(
    ("x", "y", "said"),
    [
        ("far west", "far south", "in the far south-west"),
        ("east", "north", "in the north-east"),
        ("west", "far south", "in the far south and west"),
        ("middle", "middle", "in the middle"),
        ("middle", "far north", "in the middle of the far north"),
        ("east", "middle", "in the middle of the east"),
        ("west to middle", "south", "in the south, from west to middle"),
        ("west to middle", "middle", "in the middle row, from west to middle"),
        ("middle", "", "in the middle column"),
        ("", "far south", "in the far south"),
        ("", "", "anywhere"),
    ],
)
def test_places_of_a_maze_read_as_one_says_them(x, y, said):
    assert terms.where([X, Y], [x, y]) == said
    beside = [*(part for part in [said] if part != "anywhere"), "heading north"]
    assert terms.where([X, Y, HEADING], [x, y, "north"]) == ", ".join(beside)


def test_ten_rules_by_hand_are_what_was_meant(ten):
    said = terms.sentences(ten, words.read(ten), 5)
    assert (
        said[0] == "In the far south, from west to middle, heading south-east to east: turn left."
    )
    assert (
        said[1] == "In the far south, from west to middle, heading east to north-east: turn right."
    )
    assert said[3] == "In the south and far east, heading north to north-west: turn right."
    three = terms.sentences(ten, words.read(ten), 3)
    assert three[4] == "In the middle, heading north-west to west: turn left."


def test_what_is_outvoted_says_by_what(ten):
    centres = torch.tensor([[0.5, 0.5, 0.0]] * 3)
    mu = torch.tensor([[-1.0, 0.1, 0.6], [1.0, 0.1, 0.6], [1.0, 0.1, 0.6]])
    ten.net.replace_rules(centres, torch.full((3, 3), 0.1), mu)
    said = terms.sentences(ten, words.read(ten))
    place = "In the middle, heading east: "
    assert said[0] == f"{place}turn right (outvoted: all rules together go straight there)."
    assert said[1] == f"{place}turn left (outvoted: all rules together go straight there)."


@pytest.mark.parametrize(
    ("kind", "starts", "ends"),
    [
        ("car", "Position ", ("push left.", "no push.", "push right.", "there).")),
        ("pole q", "Cart position ", ("push left.", "push right.", "undecided.", "there).")),
        ("pendulum", "Cosine of angle ", (").",)),
        ("wheels", "In the ", (").",)),
    ],
)
def test_other_tasks_speak_of_their_own_axes_and_actions(kind, starts, ends):
    _, agent = learner(kind)
    agent.net.replace_rules(  # narrow ones: nothing is left out
        agent.net.centres, agent.net.widths * 0.1, agent.net.consequents
    )
    said = terms.sentences(agent, words.read(agent))
    assert len(said) == agent.net.n_rules
    for line in said:
        assert line.startswith(starts if kind != "wheels" else "In ") and line.endswith(ends), line
        assert line.count("  ") == 0 and "nan" not in line


def test_numbers_of_an_action_are_said_in_terms_of_their_range():
    _, agent = learner("wheels")
    said = terms.sentences(agent, words.read(agent))
    for line, (left, _) in zip(said, agent.net.consequents[:, :2].tolist(), strict=True):
        name = next(
            name for edge, name in [(-0.6, "very negative"), (-0.2, "negative"), (0.2, "near zero"),
            (0.6, "positive"), (9, "very positive")] if left < edge
        )  # fmt: skip
        assert f"left wheel {name} ({words.number(left)})" in line


def test_a_rule_about_one_action_says_what_that_is_worth():
    _, agent = learner("q antecedent")
    read, codes = words.read(agent), [-1.0, 0.0, 1.0]
    for k, line in enumerate(terms.sentences(agent, read)):
        action = agent.net.centres[k, -1].item()
        name = agent.choices[min(range(3), key=lambda j: abs(codes[j] - action))]
        assert f": {name} is worth " in line and "action" not in line


def test_an_axis_without_ends_is_cut_where_the_rules_are():
    assert terms.terms(Axis("load"), 3, (0.0, 9.0)).names == ["low", "medium", "high"]
    assert terms.terms(Axis("load"), 3, (0.0, 9.0)).of(3.1, 0.1) == "medium"
    assert terms.terms(Axis("load"), 4, (-2.0, 2.0)).names[0] == "very negative"


def test_the_bounds_of_the_terms_are_told():
    assert terms.terms(X, 3).bounds() == "x in mm: west < 333 < middle < 667 < east"
    assert terms.terms(CAR, 2).bounds() == "position: left < -0.30 < right"
    assert terms.terms(HEADING, 5).bounds() == "heading: 8 equal parts, east is around 0"


def test_rules_come_in_the_order_of_the_way(ten):
    centres = ten.net.centres.numpy()
    way = centres[[4, 0, 9]].copy()
    assert played.moments(ten, way)[[4, 0, 9]].tolist() == [0, 1, 2]
    shares = np.full(10, 1e-6)
    shares[[4, 0, 9]] = 0.3
    said = [f"rule {k}." for k in range(10)]
    text = tables.along_the_way(said, shares, played.moments(ten, way), 3, 4)
    lines = [line.split() for line in text.splitlines()[1:]]
    assert [line[:2] for line in lines[:3]] == [["1", "5"], ["2", "1"], ["3", "10"]]
    assert lines[3][0] == "2" and len(lines) == 4  # the fourth took no part: last, no decision


def test_the_command_prints_a_sentence_for_each_rule(call, few):
    code, text, _ = call(few[0], "--words", 5, "--top", 0)
    assert code == 0
    lines = [line for line in text.splitlines() if ": " in line and "%  " in line]
    assert len(lines) == few[1].net.n_rules
    assert all("heading" in line and line.endswith(".") for line in lines)
    assert "x in mm: far west < 200 < west" in text


def test_words_are_for_the_list_of_rules(call, few, tmp_path):
    code, _, error = call(few[0], "--words", 5, "--at", 0.1, 0.1, 0)
    assert code == 2 and "--at and --words do not go together" in error
    code, _, error = call(few[0], "--words", 9)
    assert code == 2 and "--words must lie in [2, 7], got 9" in error
    file = written(few[1], tmp_path / "rules.json")
    assert call(few[0], "--load", file, "--words", 5)[0] == 2
