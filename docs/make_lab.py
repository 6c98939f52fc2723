"""Make the picture of the lab from a run, with Chromium: python docs/make_lab.py RUN."""

import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from PIL import Image

from sofnn_torch.evaluate import load
from sofnn_torch.rules import lab, played
from sofnn_torch.terminal import command

OUT = Path(__file__).parent / "images" / "lab.png"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = "--headless --no-sandbox --disable-gpu --hide-scrollbars --virtual-time-budget=5000"
SHOW = "Object.assign(view, { pose: [0.702, 0.15, 0], chosen: 463 }); toTrial(data.trial);"


@dataclass(frozen=True)
class Options:
    """Draw the page of a run with a rule chosen."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Directory of the run."""


def main(options: Options) -> None:
    """Write the page, open it, choose a rule, take a picture."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if not browser:
        raise ValueError(f"needs one of {', '.join(BROWSERS)}")
    loaded = load(options.run)
    states = played.trial(loaded.config, loaded.agent, 1, 1000).states
    with tempfile.TemporaryDirectory() as folder:
        page, picture = Path(folder) / "lab.html", Path(folder) / "lab.png"
        lab.write(page, options.run, loaded, states)
        chosen = f"<script>{SHOW} update({{ editor: true }}); showOthers();</script></body>"
        page.write_text(page.read_text("utf-8").replace("</body>", chosen), "utf-8")
        places = [f"--user-data-dir={folder}/browser", f"--screenshot={picture}"]
        subprocess.run(
            [browser, *FLAGS.split(), "--window-size=1360,1240", *places, page.as_uri()],
            check=True,
            capture_output=True,
            timeout=300,
        )
        Image.open(picture).convert("P", palette=Image.Palette.ADAPTIVE).save(OUT, optimize=True)


if __name__ == "__main__":
    command(main, Options, __doc__)
