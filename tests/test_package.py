"""The installed package works away from the checkout: a wheel in a fresh virtual environment."""

import ast
import json
import os
import re
import runpy
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import sofnn_torch

ROOT = Path(__file__).parents[1]


def run(*command, cwd, **variables):
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **variables}
    environment.pop("PYTHONPATH", None)
    done = subprocess.run(
        [str(word) for word in command], cwd=cwd, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    run(*(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder), cwd=ROOT)
    (file,) = folder.glob("*.whl")
    return file


@pytest.fixture(scope="module")
def home(wheel, tmp_path_factory):
    """A virtual environment with the wheel; it borrows the dependencies of this one."""
    folder = tmp_path_factory.mktemp("installed")
    venv.create(folder / "venv", with_pip=False)
    python = folder / "venv" / "bin" / "python"
    run(
        *(sys.executable, "-m", "pip", "--python", python, "install", "--quiet"),
        *("--no-deps", "--no-index", "--no-compile", wheel),
        cwd=folder,
    )
    site = next((folder / "venv" / "lib").glob("python*")) / "site-packages"
    (site / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return folder


def test_files_are_data():
    """Nothing evaluates text, unpickles, or loads a checkpoint in a way that could run code."""
    forbidden = {"eval", "exec", "compile", "__import__", "execfile"}
    for path in [*Path(sofnn_torch.__file__).parent.rglob("*.py"), ROOT / "train.py"]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = {alias.name for alias in node.names} | {getattr(node, "module", "")}
                assert not names & {"pickle", "marshal", "shelve", "dill", "cloudpickle"}, path
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in forbidden, path
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("torch.load", "np.load"):
                safe = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
                assert safe.get("weights_only") == "True", f"{path}: {ast.unparse(node)}"


def test_the_wheel_holds_the_assets_and_its_types_and_no_tests(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {"sofnn_torch/assets/khepera_maze.xml", "sofnn_torch/py.typed"} <= names
    pages = {f"sofnn_torch/assets/lab/{path.name}" for path in (ROOT / "assets/lab").iterdir()}
    assert "sofnn_torch/assets/lab/lab.html" in pages and pages <= names
    assert not [name for name in names if name.startswith(("tests", "docs", "runs"))]


def test_the_installed_package_trains_and_evaluates_elsewhere(home):
    scripts = home / "venv" / "bin"
    flags = ["--trials", "2", "--maze.max-steps", "100", "--quiet"]
    run(scripts / "sofnn-train", *flags, cwd=home)
    (directory,) = (home / "runs").iterdir()
    look = f"""
import sys
from importlib.metadata import entry_points
import gymnasium, sofnn_torch
print(sofnn_torch.__file__)
print(gymnasium.make("sofnn_torch:KheperaMaze-v0").reset(seed=0)[0].shape)
for command in entry_points(group="console_scripts"):
    if command.name.startswith("sofnn-"):
        print(command.name, callable(command.load()))
sys.argv = ["sofnn-evaluate", {str(directory)!r}, "--episodes", "2", "--json", "r.json"]
(evaluate,) = entry_points(group="console_scripts", name="sofnn-evaluate")
sys.exit(evaluate.load()())
"""
    place, shape, *rest = run(scripts / "python", "-c", look, cwd=home).splitlines()
    assert Path(place).is_relative_to(home) and shape == "(3,)"
    names = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert {f"{name} True" for name in names} <= set(rest)
    assert all((scripts / name).exists() for name in names)
    assert any("2 trials learned" in line for line in rest)
    assert len(json.loads((home / "r.json").read_text())["trials"]) == 2


RELATIVE = re.compile(r"\]\((?!https?:|#)([^)\s]+)\)")


def test_a_package_index_is_shown_no_relative_link_or_picture(wheel):
    files = zipfile.ZipFile(wheel)
    (name,) = (name for name in files.namelist() if name.endswith(".dist-info/METADATA"))
    text = files.read(name).decode()
    assert "Description-Content-Type: text/markdown" in text and "## Two commands" in text
    assert RELATIVE.findall(text) == []


def test_links_and_pictures_take_the_address_of_the_repository():
    text, pages = (ROOT / "README.md").read_text(), runpy.run_path(str(ROOT / "hatch_build.py"))
    paths, plain = RELATIVE.findall(text), pages["for_index"](text)
    assert RELATIVE.findall(plain) == [] and "](https://mujoco.org)" in plain
    assert "![" not in plain and "Four trials of one run" not in plain
    full = pages["for_index"](text, "https://host.example/us/it/")
    assert RELATIVE.findall(full) == []
    found = re.findall(
        r"(!?)\[[^\]]*\]\(https://host.example/us/it/(raw|blob)/HEAD/([^)]+)\)", full
    )
    assert sorted(path for *_, path in found) == sorted(paths)
    assert all((kind == "raw") == bool(mark) for mark, kind, _ in found)


@pytest.mark.slow
def test_the_files_of_a_release_pass_the_check_of_a_package_index(tmp_path):
    pytest.importorskip("twine", reason="needs twine: pip install twine")
    build = (sys.executable, "-m", "build", "--no-isolation", "--outdir", tmp_path, ROOT)
    run(*build, cwd=tmp_path)
    files = sorted(tmp_path.iterdir())
    assert [file.suffix for file in files] == [".whl", ".gz"]
    run(sys.executable, "-m", "twine", "check", "--strict", *files, cwd=tmp_path)


def test_constraints_pin_every_requirement():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    needed = [*project["dependencies"], *extras["test"], *extras["docs"]]
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = {line.split("==")[0].lower() for line in lines if "==" in line}
    names = {requirement.split(">=")[0].split("[")[0].lower() for requirement in needed}
    assert names <= pinned


def test_the_version_is_the_same_everywhere():
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {sofnn_torch.__version__}\n" in citation
    assert f"## {sofnn_torch.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_the_examples_of_the_readme_work():
    text = (ROOT / "README.md").read_text()
    examples = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(examples) == 2
    for example in examples:
        exec(example, {})


def python(code, **environment):
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=os.environ | environment
    )
    return done.returncode, done.stdout.strip(), done.stderr.strip()


def test_every_name_of_the_package_can_be_imported():
    assert sorted(sofnn_torch.__all__) == sorted(sofnn_torch.HOMES)
    assert all(getattr(sofnn_torch, name) for name in sofnn_torch.__all__)
    assert set(sofnn_torch.__all__) <= set(dir(sofnn_torch))
    with pytest.raises(AttributeError, match="has no attribute 'SONFN'"):
        sofnn_torch.SONFN  # noqa: B018


def test_the_folders_of_the_package_import_each_other_in_one_direction():
    package = ROOT / "sofnn_torch"
    folders = {path.name for path in package.iterdir() if (path / "__init__.py").exists()}
    needs = {folder: set() for folder in folders}
    for folder in folders:
        for path in (package / folder).rglob("*.py"):
            for node in ast.parse(path.read_text()).body:
                if isinstance(node, ast.ImportFrom) and node.module.startswith("sofnn_torch"):
                    names = [f"{node.module}.{alias.name}" for alias in node.names]
                    needs[folder] |= {name.split(".")[1] for name in names} & folders - {folder}
    assert needs["learners"] == {"network"}
    assert list(TopologicalSorter(needs).static_order())  # or CycleError names the circle


def test_the_network_and_the_learners_load_without_the_simulator():
    heavy = "'mujoco', 'matplotlib', 'scipy', 'tensorboard'"
    names = "SOFNN, grid, Axis, SGA, QLearning, Task"
    code = f"from sofnn_torch import {names}; import sys; print({{{heavy}}} & {{*sys.modules}})"
    assert python(code) == (0, "set()", "")
