"""Pictures show what they claim; plans agree with the learner that they ask."""

import io
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from matplotlib.patches import Rectangle
from PIL import Image

from sofnn_torch.maze.spaces import motion
from sofnn_torch.pictures import figures
from sofnn_torch.runs.factory import make_agent, make_env
from sofnn_torch.runs.settings import Config
from sofnn_torch.runs.trial import Trajectory

RNG = np.random.default_rng(7)
STATES = np.column_stack([RNG.uniform(0, 1, (60, 2)), RNG.uniform(-math.pi, math.pi, 60)])


@pytest.fixture(scope="module")
def plan():
    env = make_env(Config(agent="sga", network="sofnn"))
    yield env.unwrapped.plan
    env.close()


@pytest.fixture
def axes():
    return figures.canvas()[1][0]


def learner(kind, actions="three", **settings):
    """A learner with rules at STATES and random consequents."""
    config = Config(agent=kind, network="sofnn")
    parts = {kind: replace(getattr(config, kind), **settings)}
    config = replace(config, maze=replace(config.maze, actions=actions), **parts)
    agent = make_agent(config)
    inputs, outputs = agent.net.n_inputs, agent.net.n_outputs
    rng = np.random.default_rng(3)
    for state in STATES:
        centre = [*state, rng.uniform(-1, 1)][:inputs]
        consequents = rng.uniform(-1, 1, outputs)
        if kind == "sga":
            consequents[agent.m : 2 * agent.m] = 0.1
        agent.net.add_rule(
            torch.tensor(centre).float(), consequents=torch.tensor(consequents).float()
        )
    return agent


@pytest.mark.parametrize("coding", ["onehot", "wheels", "scalar", "antecedent"])
def test_the_plan_of_q_agrees_with_the_greedy_action(coding):
    agent = learner("q", coding=coding)
    turns = [agent.act(state.astype(np.float32)) - 1 for state in STATES]
    answer = agent.plan(STATES.astype(np.float32))
    forward, turn = motion(answer.actions)
    assert turn.tolist() == turns
    assert forward.tolist() == [1 - abs(turn) for turn in turns]
    state = torch.tensor(STATES[0]).float()
    firing = agent.net.normalised_firing(agent.network_inputs(state))
    assert answer.value[0] == pytest.approx(agent.action_values(state, firing).max().item(), 1e-4)


@pytest.mark.parametrize("actions", ["three", "steer", "wheels"])
def test_the_plan_of_sga_agrees_with_the_mean_action(actions):
    agent = learner("sga", actions=actions)
    answer = agent.plan(STATES.astype(np.float32))
    forward, turn = motion(answer.actions)
    for i, state in enumerate(STATES.astype(np.float32)):
        action = agent.act(state)
        if actions == "three":
            expected = float(action == 1), action - 1
        elif actions == "steer":
            expected = 1 - abs(action[0]), action[0]
        else:  # the fastest turn, wheels at -0.4 and 0.4, counts as 1
            expected = action.mean(), np.clip((action[1] - action[0]) / 0.8, -1, 1)
        assert (forward[i], turn[i]) == pytest.approx(expected, abs=1e-5)
    assert answer.value == pytest.approx(agent.net(torch.tensor(STATES).float())[:, -1].detach())


def test_a_learner_without_values_has_no_value_field(plan, axes):
    agent = learner("sga", baseline="constant", replays=0)
    assert agent.plan(STATES).value is None
    with pytest.raises(ValueError, match="baseline"):
        figures.value_field(plan, agent, axes)


@pytest.mark.parametrize("coding", ["onehot", "antecedent"])
def test_usage_is_a_share(coding):
    agent = learner("q", coding=coding)
    share = agent.usage(STATES[:5])
    assert share.shape == (60,)
    assert share.sum() == pytest.approx(1, abs=1e-5)
    if coding == "onehot":
        assert set(np.argsort(share)[-5:]) == set(range(5))  # the rules at these very states


def test_the_plan_shows_every_wall_inside_the_axes(plan, axes):
    figures.maze_plan(plan, axes)
    boxes = [patch for patch in axes.patches if isinstance(patch, Rectangle)]
    assert len(boxes) == len(plan.walls) >= 6
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    assert all(x0 <= a and c <= x1 and y0 <= b and d <= y1 for a, b, c, d in plan.walls)
    assert "[m]" in axes.get_xlabel()
    assert {"goal", "start", "sub-goal 1"} <= {text.get_text() for text in axes.texts}


def test_the_policy_is_drawn_only_where_the_robot_can_be(plan, axes):
    figures.action_field(plan, learner("sga"), axes)
    spokes = np.array(axes.collections[0].get_segments())[:, 0]
    for x0, y0, x1, y1 in plan.walls:
        inside = (spokes > (x0, y0)) & (spokes < (x1, y1))
        assert not inside.all(1).any()
    assert len(spokes) > 400


def test_the_policy_bends_to_the_side_of_the_turn(plan, axes):
    agent = learner("sga")
    for value, side in ((1.0, 1), (-1.0, -1)):
        agent.net.consequents[:, 0] = value  # every rule turns to one side
        axes.clear()
        figures.action_field(plan, agent, axes, headings=4)
        begin, end = np.array(axes.collections[0].get_segments())[0]  # heading -pi, to the west
        assert math.copysign(1, -(end - begin)[1]) == side  # facing west, left is south


def test_rule_map_shows_every_rule(plan, axes):
    agent = learner("q", coding="antecedent")
    figures.rule_map(plan, agent, axes, agent.usage(STATES))
    dots = axes.collections[1]
    assert dots.get_offsets().data == pytest.approx(STATES[:, :2], abs=1e-6)
    assert len(set(dots.get_sizes())) > 1


def test_learning_curves_are_medians_of_the_common_trials(tmp_path, axes):
    tables = [[900, 700, 500, 480], [1000, 600, 520], [800, 800, 510], [850, 650, 400], [950] * 3]
    paths = []
    for i, steps in enumerate(tables):
        paths.append(tmp_path / f"{i}.csv")
        rows = [f"{t},{n},True" for t, n in enumerate(steps, 1)]
        paths[-1].write_text("\n".join(["trial,steps,success", *rows]) + "\n")
    figures.learning_curves({"SOFNN": paths}, axes, reference=("optimum", 470))
    median = next(line for line in axes.lines if line.get_label() == "SOFNN (5 seeds)")
    assert median.get_xdata().tolist() == [1, 2, 3]
    assert median.get_ydata().tolist() == [900, 700, 510]
    assert [900, 700, 500, 480] in [list(line.get_ydata()) for line in axes.lines]
    assert all(tick == round(tick) for tick in axes.get_xticks())
    assert axes.get_yscale() == "log"
    assert figures.read_column(paths[0], "success").tolist() == [1, 1, 1, 1]
    with pytest.raises(ValueError, match="rules"):
        figures.read_column(paths[0], "rules")
    with pytest.raises(ValueError, match="at most 5 arms"):
        figures.learning_curves({str(i): paths for i in range(6)}, axes)


def test_fewer_than_five_seeds_are_lines_without_a_median_or_a_band(axes):
    few = [np.array([seed, 10.0 * seed]) for seed in (1, 2, 3, 4)]
    figures.learning_curves({"few": few, "one": few[:1]}, axes, "rules")
    assert [list(line.get_ydata()) for line in axes.lines] == [*map(list, few), [1, 10]]
    assert not axes.collections and not axes.get_legend().get_title().get_text()
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["few (4 seeds)", "one"]
    figures.learning_curves({"many": [*few, few[0]]}, axes, "rules")
    assert "band: quartiles" in axes.get_legend().get_title().get_text()


def test_a_column_of_trials_is_read_as_resuming_reads_it(tmp_path):
    file = tmp_path / "trials.csv"
    file.write_text("\ufefftrial;steps;success;error\n1;9;True;0,5\n2;8;False;nan\n")
    assert figures.read_column(file, "success").tolist() == [1, 0]
    assert figures.read_column(file, "steps").tolist() == [9, 8]
    assert str(figures.read_column(file, "error").tolist()) == "[0.5, nan]"
    file.write_text("name,age\nann,3\n")
    with pytest.raises(ValueError, match=r"trials.csv: its first line is 'name,age'"):
        figures.read_column(file, "steps")


@pytest.mark.parametrize("cell", ["", "1_0", "\u0661", "1e999", "0x1", " 1", "Infinity", "TRUE"])
def test_only_plain_numbers_are_numbers_of_a_column(cell, tmp_path):
    file = tmp_path / "trials.csv"
    file.write_text(f"trial,steps\n1,{cell}\n")
    with pytest.raises(ValueError, match=r"trials.csv: steps must be a number, got '"):
        figures.read_column(file, "steps")


def test_pose_error_is_in_millimetres_and_marks_the_subgoals(plan, axes):
    true = np.array([[0.15, 0.15, 0], [0.5, 0.15, 0], [0.85, 0.333, 1], [0.5, 0.5, 3]])
    estimated = true + np.array([[0, 0, 0], [0.003, 0.004, 0], [0, 0, 0], [0, -0.002, 0]])
    figures.pose_error(Trajectory(true, estimated), axes, plan)
    assert axes.lines[0].get_ydata() == pytest.approx([0, 5, 0, 2])
    assert [text.get_text() for text in axes.texts] == ["sub-goal 1"]
    assert "[mm]" in axes.get_ylabel()


def test_labels_of_near_subgoals_do_not_overlap(plan):
    far = np.linspace((0.15, 0.15), (0.7, 0.15), 100)
    true = np.concatenate([far, [plan.subgoals[0], (0.5, 0.5), plan.subgoals[1], plan.goal]])
    figure, (axes,) = figures.canvas(width=3.8, height=3)
    figures.pose_error(Trajectory(true, true), axes, plan)
    figure.draw_without_rendering()
    first, second = (text.get_window_extent() for text in axes.texts)
    assert first.x1 > second.x0 and first.y1 <= second.y0


def test_a_figure_becomes_a_png_of_its_size(plan):
    figure, (left, right) = figures.canvas(2, width=3, height=2)
    path = Trajectory(STATES, STATES)
    figures.trajectory(plan, path, left)
    figures.value_field(plan, learner("sga"), right, columns=8, headings=2)
    assert Image.open(io.BytesIO(figures.png(figure, dpi=50))).size == (300, 100)


def test_the_band_of_learning_curves_lies_between_the_quartiles_and_seeds_begin_with_trial_1(axes):
    runs = [np.array([seed, 10.0 * seed]) for seed in (1, 2, 3, 4, 5)]
    figures.learning_curves({"arm": runs}, axes, "rules")
    (band,) = axes.collections
    low, high = band.get_paths()[0].get_extents().get_points()
    assert (*low, *high) == pytest.approx((1, 2, 2, 40))
    assert {tuple(line.get_xdata()) for line in axes.lines} == {(1, 2)}


def test_subgoals_are_shaded_from_half_a_decision_before_to_half_a_decision_after(plan, axes):
    inside, outside = (*plan.subgoals[0], 0.0), (*plan.start[:2], 0.0)
    true = np.array([outside, outside, inside, inside, outside])
    figures.pose_error(Trajectory(true, true), axes, plan)
    (shade,) = axes.patches
    assert (shade.get_x(), shade.get_x() + shade.get_width()) == (1.5, 3.5)


def test_the_value_field_shows_the_best_heading(plan, axes):
    agent = learner("sga")
    figures.value_field(plan, agent, axes, columns=10, headings=4)
    picture = axes.images[0].get_array()
    x0, y0, x1, _ = figures.bounds(plan)
    step = (x1 - x0) / 10
    at = [[x0 + 3.5 * step, y0 + 6.5 * step, turn * math.pi / 2] for turn in range(-2, 2)]
    assert picture[6, 3] == pytest.approx(agent.plan(np.array(at)).value.max(), rel=1e-5)


def test_a_membership_function_is_1_at_its_centre_and_falls_as_equation_1_says(axes):
    agent = learner("sga")
    figures.memberships(agent, 0, axes, {4: "rule"})
    x, y = axes.lines[0].get_data()
    distance = (x - STATES[4, 0]) / agent.net.widths[4, 0].item()
    assert y == pytest.approx(np.exp(-(distance**2) / 2), abs=1e-5)
