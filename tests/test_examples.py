"""The examples do what they say: those in docstrings, and examples/."""

import doctest
import importlib
import math
import pkgutil
import re
import runpy
from pathlib import Path

import gymnasium
import pytest

import sofnn_torch
from sofnn_torch import Config, RunOptions, load, train
from sofnn_torch.pictures.film import film

ROOT = Path(__file__).parents[1]
MODULES = [
    importlib.import_module(found.name)
    for found in pkgutil.walk_packages(sofnn_torch.__path__, "sofnn_torch.")
    if not found.name.endswith("__main__")
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


def shown_names():
    """What the package offers, and what the pages of the reference show."""
    pages = [page.read_text() for page in (ROOT / "docs" / "reference").glob("*.md")]
    return {f"sofnn_torch.{name}" for name in sofnn_torch.__all__} | {
        name for page in pages for name in re.findall(r"^::: (\S+)$", page, re.MULTILINE)
    }


def test_every_class_that_is_offered_shows_how_it_is_used():
    offered = [pkgutil.resolve_name(name) for name in shown_names()]
    classes = [thing for thing in offered if isinstance(thing, type)]
    assert len(classes) > 20
    shown = {example.id for example in EXAMPLES}
    assert [c for c in classes if f"{c.__module__}.{c.__qualname__}" not in shown] == []


def test_the_reference_shows_all_that_the_package_offers():
    pages = "".join(page.read_text() for page in (ROOT / "docs" / "reference").glob("*.md"))
    assert [n for n in sofnn_torch.__all__ if f"::: sofnn_torch.{n}\n" not in pages] == []


def test_a_function_is_fitted_while_the_network_grows(capsys):
    runpy.run_path(str(ROOT / "examples" / "regression.py"), run_name="__main__")
    found = re.match(r"(\d+) rules, error (\S+) .*constant: (\S+)\n$", capsys.readouterr().out)
    rules, error, constant = map(float, found.groups())
    # Of sin(6 a) b: its mean square less the square of its mean, by integration.
    assert constant == pytest.approx(0.415, abs=0.01)
    assert error < 0.03
    assert 15 < rules < 60


def example(name):
    return runpy.run_path(str(ROOT / "examples" / f"{name}.py"))


def test_a_robot_behind_a_socket_learns_the_shortest_way(capsys):
    example("own_loop")["main"]()
    first, last = map(int, re.findall(r"\d+", capsys.readouterr().out))
    assert first > 40 and last < 25  # 0.8 m by commands of 40 to 60 mm


def test_a_task_of_gymnasium_is_learned_in_a_few_lines(capsys):
    example("gymnasium_task")["main"](trials=3)
    first, learned = map(int, re.findall(r"(\d+)(?: in|  *learned)", capsys.readouterr().out))
    assert first > 0 and learned > 0


def test_a_reward_and_an_observation_of_ones_own(capsys):
    parts = example("own_reward")
    env = parts["Angle"](parts["Height"](gymnasium.make("Pendulum-v1")))
    seen, _ = env.reset(seed=0)
    seen, reward, *_ = env.step([0.0])
    assert seen in env.observation_space and reward == pytest.approx(math.cos(seen[0]), abs=1e-6)
    parts["main"](trials=2)
    assert capsys.readouterr().out.startswith("mean height -")


def test_an_agent_of_stable_baselines3_learns_in_the_maze(capsys):
    pytest.importorskip("stable_baselines3", reason="needs pip install -e '.[peers]'")
    example("sb3_maze")["main"](decisions=500, trials=1)
    assert re.match(
        r"mean return -?\d+ untrained, -?\d+ after 500 decisions\n", capsys.readouterr().out
    )


def test_a_task_of_ones_own_is_trained_by_its_name_and_filmed(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "examples")
    config = Config(env="own_task:Parking-v0", agent="q", trials=2)
    run = train(config, RunOptions(runs=tmp_path, video_every=0, picture_every=0, quiet=True))
    config, agent, _, _ = load(run)
    assert [axis.high for axis in config.task.axes] == [1, 1]
    frames = list(film(config, agent, limit=3))
    assert len(frames) == 4 and frames[0].shape == (32, 256, 3)
    assert (frames[0] == 0).all(axis=-1).sum() == 24 * 16  # the cart, in black


@pytest.mark.filterwarnings("ignore:.*already in registry")
def test_a_cart_parks_where_it_comes_to_rest_at_the_mark():
    cart = example("own_task")["Parking"]()
    cart.reset(seed=0)
    cart.place, cart.speed = 0.70, 0.1  # rolls 10 mm a step: at 0.76 it is near enough
    ends = [cart.step(1)[2] for _ in range(6)]
    assert ends == [False] * 5 + [True]
    cart.place, cart.speed = 0.76, 0.4  # through the mark without a stop
    assert not cart.step(1)[2]
