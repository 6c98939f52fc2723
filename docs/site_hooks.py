"""Make a site of pages that are written for a code host; MkDocs calls this (see mkdocs.yml).

The pages beside docs/ come into it, files of the checkout that pages point to come along as they
are, and formulas become MathML, which browsers draw without a script.
"""

import html
import posixpath
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
BESIDE = {name: name.lower() for name in ("CONTRIBUTING.md", "CODE_OF_CONDUCT.md", "CHANGELOG.md")}
LINK = re.compile(r"(?<=\]\()[^)\s]+(?=\))")
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_files(files: Files, config: Any) -> None:
    """Add the pages that lie beside docs/."""
    for name, page in BESIDE.items():
        files.append(File.generated(config, page, content=(ROOT / name).read_text()))


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Point the links that leave docs/ to where their goals lie in the site."""
    here = page.file.src_uri
    source = next((name for name, to in BESIDE.items() if to == here), f"docs/{here}")

    def moved(link: re.Match[str]) -> str:
        path, mark, anchor = link[0].partition("#")
        if not path or ":" in path:
            return link[0]
        goal = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
        place = BESIDE.get(goal, goal.removeprefix("docs/"))
        if goal == "README.md":
            place, mark, anchor = "index.md", "", ""
        elif place == goal:  # neither a page of docs/ nor beside it
            if (ROOT / goal).is_dir():
                goal = f"{goal}/{next((ROOT / goal).iterdir()).name}"
            place = f"files/{goal}"
            if not files.get_file_from_path(place):
                files.append(File.generated(config, place, content=(ROOT / goal).read_bytes()))
        return posixpath.relpath(place, posixpath.dirname(here) or ".") + mark + anchor

    return LINK.sub(moved, markdown)


def on_page_content(content: str, **_: Any) -> str:
    """Draw the formulas, in the line or as a block."""

    def drawn(found: re.Match[str]) -> str:
        shape = {"span": "inline", "div": "block"}[found[1]]
        return convert(html.unescape(found[2]), display=shape)

    return FORMULA.sub(drawn, content)
