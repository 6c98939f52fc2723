"""A step of the build: README as a package index shows it, without the files beside it."""

import re
from pathlib import Path

from hatchling.metadata.plugin.interface import MetadataHookInterface

PICTURE = re.compile(r"!\[([^\]]*)\]\((?!https?:)([^)\s]+)\)")
CAPTIONED = re.compile(PICTURE.pattern + r"\n\n\*.*?\*\n\n", re.DOTALL)
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((?!https?:|#)([^)\s]+)\)")


def for_index(text: str, address: str = "") -> str:
    """The page with links and pictures at the address of the repository.

    Without an address relative links become their words, and pictures with their captions are
    left out.
    """
    if not address:
        return LINK.sub(r"\1", PICTURE.sub("", CAPTIONED.sub("", text)))
    address = address.rstrip("/")
    return LINK.sub(
        rf"[\1]({address}/blob/HEAD/\2)", PICTURE.sub(rf"![\1]({address}/raw/HEAD/\2)", text)
    )


class CustomMetadataHook(MetadataHookInterface):
    """Gives the package its description."""

    def update(self, metadata: dict) -> None:
        """Set `readme`; the address is that of `Repository` in `[project.urls]`."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        text = for_index(text, metadata.get("urls", {}).get("Repository", ""))
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
