"""What the pages say can be done: every command and every block of code, and the links.

Each command is parsed here with the flags that it has, and run by the slow tests: a page at a time,
from its top to its end in a directory of its own, with few trials instead of many.
"""

import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
import unicodedata
from pathlib import Path

import pytest
from conftest import quick_options, settings

from sofnn_torch import cli, terminal, training
from sofnn_torch.maze.rendering import RenderingError, choose_backend
from sofnn_torch.rules import new

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
ALL_PAGES = [*PAGES, *ROOT.glob("C*.md"), *(ROOT / "docs").glob("*/*.md")]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?<=\n\n)((?: {4}.*\n|\n(?= {4}))+)")
COMMAND = re.compile(
    r"(python|pip|echo|cp|tensorboard|for|done|[A-Z_]+=|\.ci/run| +python|sofnn-(?!torch ))"
)

# What is not run, and why.
LEFT = {
    r"python3 -m venv|pip install|-m pytest": "the set-up: .ci/run, tests/test_package.py",
    r"^\.ci/run": "runs these tests",
    r"^tensorboard|mkdocs": "serves until it is stopped",
    r"--reduce|-20-rules": "needs a policy that has learned; tests/test_reducing.py",
    r"--cluster|^dask ": "needs a cluster; tests/test_cluster.py",
    r"--viewer": "needs a display; tests/test_viewer.py",
    r"^python benchmarks/": "takes minutes and other packages; tests/test_benchmarks.py",
}
FEW_STEPS = "--maze.max-steps 2000"
# What is done with fewer trials than the page says; appended flags win.
SHORTER = [
    (r"--trials \d+", "--trials 3"),
    (r"--tries \d+", "--tries 2"),
    (r"--episodes \d+", "--episodes 2"),
    (r"--seeds \d+-\d+", "--seeds 0-1"),
    (r"checkpoint-100", "checkpoint-2"),
    (r"\btrials=\d+", "trials=2"),
    (r"(python train\.py(?!.*--(?:trials|help|resume|again))[^#\n]*)", r"\1 --trials 2 "),
    (r"(python train\.py(?!.*--(?:env|settings|help|resume|again))[^#\n]*)", rf"\1 {FEW_STEPS} "),
    (r"(sofnn_torch\.studies[^#\n]*)", r"\1 --seeds 0 --trials 1 --max-steps 300 "),
]


def blocks(page):
    """Kind and text of each block of a page, from its top to its end."""
    text = page.read_text()
    found = [(m.start(), m[1], m[2]) for m in FENCE.finditer(text)]
    plain = FENCE.sub(lambda m: re.sub(r"[^\n]", "x", m[0]), text)
    for m in INDENTED.finditer(plain):
        lines = [line[4:] for line in text[m.start() : m.end()].splitlines()]
        commands = [line for line in lines if COMMAND.match(line)]
        found.append((m.start(), "bash" if commands else "text", "\n".join(commands) + "\n"))
    return [(kind, body) for _, kind, body in sorted(found)]


def commands(body):
    """The commands of a block: joined lines, without comments."""
    joined = re.sub(r"(\\|&&)\n\s*", lambda m: " " if m[1] == "\\" else "&& ", body)
    return [line.strip() for line in joined.splitlines() if line.strip()]


def left(command):
    return any(re.search(pattern, command) for pattern in LEFT)


def words(command):
    """Arguments after `python train.py` or `python -m sofnn_torch.x`, and which; else None."""
    found = re.search(r"python (train\.py|-m (sofnn_torch[\w.]*))(.*)$", command)
    if not found or left(command):
        return None
    given = re.sub(r"\$?\bRUN\b", "runs/sga-sofnn-estimated-s0", found[3]).replace("$agent", "q")
    return found[2] or "train", shlex.split(given, comments=True)


EVERY = [(page, kind, body) for page in PAGES for kind, body in blocks(page)]
PARSED = [
    pytest.param(*found, id=f"{page.name}: {command[:60]}")
    for page, kind, body in EVERY
    if kind == "bash"
    for command in commands(body)
    if (found := words(command))
]


@pytest.fixture(scope="session")
def place(tmp_path_factory):
    """A checkout with a run, and the files that the pages speak of."""
    folder = tmp_path_factory.mktemp("checkout")
    for name in ("train.py", "tests", "examples", "benchmarks", "assets", "docs"):
        (folder / name).symlink_to(ROOT / name)
    run = training.train(
        settings(trials=2, maze={"max_steps": 300}),
        quick_options(folder / "runs", name="sga-sofnn-estimated-s0"),
    )
    shutil.copy(run / "checkpoint-2.pt", run / "divergence-12.pt")
    shutil.copy(run / "checkpoint-2.pt", run / "checkpoint-100.pt")
    for name in ("first", "left", "sixty", "few"):
        shutil.copytree(run, folder / "runs" / name)
    text = next(text for kind, text in blocks(ROOT / "docs" / "scale.md") if kind == "toml")
    for file in ("best.toml", "runs/sweep-q-sofnn-CartPole-v1/best.toml"):
        (folder / file).parent.mkdir(exist_ok=True)
        (folder / file).write_text(text)
    drawn = re.search(r"\n\n((?: {4}.*\n)+)", (ROOT / "docs" / "mazes.md").read_text())[1]
    (folder / "my_maze.txt").write_text(re.sub(r"(?m)^ {4}", "", drawn))
    shutil.copy(ROOT / "examples" / "own_task.py", folder / "my_task.py")
    (folder / "my_package.py").write_text(
        "import gymnasium\n"
        "from gymnasium.envs.classic_control import CartPoleEnv\n"
        "gymnasium.register('MyTask-v0', CartPoleEnv, max_episode_steps=50)\n"
    )
    return folder


@pytest.mark.parametrize("program, argv", PARSED)
def test_the_flags_of_a_command_are_those_that_it_has(program, argv, place, monkeypatch):
    """Where they name files that earlier commands make, the slow tests go on."""
    monkeypatch.chdir(place)
    monkeypatch.syspath_prepend(str(place))
    if program == "train":
        if "--help" in argv or "--help-all" in argv:
            return
        if "sarsa:Sarsa" in argv:
            shutil.copy(ROOT / "tests" / "own.py", place / "sarsa.py")
        cli.parse(argv)
        return
    if new.is_asked(argv):  # takes the flags of train.py
        cli.parse([word.replace(new.FLAG, "--rules") for word in argv])
        return
    folder = ROOT / program.replace(".", "/")
    module = importlib.import_module(f"{program}.__main__" if folder.is_dir() else program)
    seen = []

    def parse_only(_, kind, *rest, **more):
        seen.append(terminal.parse(kind, argv, ""))

    if getattr(module, "command", None) is terminal.command:
        monkeypatch.setattr(module, "command", parse_only)
    monkeypatch.setattr(terminal, "command", parse_only)
    module.main()
    assert len(seen) == 1


def test_every_block_is_of_a_kind_that_is_tested():
    assert len(EVERY) > 50
    kinds = {"bash", "python", "toml", "c", "text"}
    assert [(page.name, kind, body) for page, kind, body in EVERY if kind not in kinds] == []
    for page, kind, body in EVERY:
        if kind == "python":
            compile(body, page.name, "exec")
        for command in commands(body) if kind == "bash" else ():
            known = left(command) or words(command) or COMMAND.match(command)
            assert known, f"{page.name}: {command}"


def script(page):
    """The page as one script for bash."""
    parts = ["set -eu"]
    drawing = True
    try:
        choose_backend()
    except RenderingError:
        drawing = False
    if page.name == "tasks.md":  # its films are of tasks that pygame draws
        drawing = importlib.util.find_spec("pygame") is not None
    for kind, body in blocks(page):
        if kind == "bash":
            lines = [c for c in commands(body) if not left(c) and (drawing or "--video" not in c)]
            parts += [re.sub(r"(?<![$\w/])RUN\b(?!=)", "$RUN", line) for line in lines]
        elif kind == "python":
            parts.append(f"python - <<'END'\n{body}END")
        elif kind == "c":
            include, rest = body.split("\n", 1)
            program = f"{include}\nint main(void) {{\n{rest}return action < 0;\n}}\n"
            parts.append("python -m sofnn_torch.export $RUN --to policy.h")
            parts.append(
                f"cat > use.c <<'END'\n{program}END\n${{CC:-cc}} -std=c99 use.c -lm && ./a.out"
            )
    text = "\n".join(parts) + "\n"
    for pattern, instead in SHORTER:
        text = re.sub(pattern, instead, text)
    return text


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)], ids=lambda p: p.name)
def test_a_page_can_be_followed_from_its_top_to_its_end(page, place, tmp_path):
    folder = tmp_path / "checkout"
    shutil.copytree(place, folder, symlinks=True)
    made = ("first", "left", "sixty", "few", "sweep-q-sofnn-CartPole-v1")
    for name in made:  # by the page itself
        shutil.rmtree(folder / "runs" / name)
    if page.name == "export.md":  # its last command reads a file of another tool
        (folder / "docs").unlink()
    if page.name == "tasks.md":
        shutil.rmtree(folder / "runs")
    here = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = os.environ | {
        "PATH": here,
        "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}",  # train.py is a link: its folder is another
        "RUN": "runs/sga-sofnn-estimated-s0",
        "MPLBACKEND": "agg",
    }
    text = script(page).replace("other.fis", "policy.fis")
    done = subprocess.run(
        ["bash", "-c", text], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, f"{text}\n{done.stdout[-2000:]}\n{done.stderr[-3000:]}"


# ---------------------------------------------------------------------------------------- links


def anchor(heading):
    """The anchor of a heading, as code hosts and the site make it."""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").replace("*", "")
    text = unicodedata.normalize("NFC", text.strip().lower())
    return re.sub(r"[^\w\- ]", "", text).replace(" ", "-")


def anchors(page):
    plain = FENCE.sub("", page.read_text())
    return {anchor(heading) for heading in re.findall(r"^#+ (.*)$", plain, re.MULTILINE)}


def links(page):
    plain = FENCE.sub("", page.read_text())
    found = re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`\n]*`(?!\])", "", plain))
    return [link for link in found if ":" not in link]


@pytest.mark.parametrize("page", ALL_PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_and_headings_that_are_there(page):
    for link in links(page):
        path, _, mark = link.partition("#")
        goal = (page.parent / path).resolve() if path else page
        assert goal.exists(), link
        if mark:
            assert mark in anchors(goal), link


def test_the_pages_of_the_site_are_all_in_its_menu():
    menu = (ROOT / "mkdocs.yml").read_text()
    for page in (ROOT / "docs").rglob("*.md"):
        assert f" {page.relative_to(ROOT / 'docs')}\n" in menu, page
