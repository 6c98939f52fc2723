"""Plain numbers: the text that is a number in a file or on a command line.

Python's own ``int`` and ``float`` also take ``1_000``, ``٣``, ``nan``, ``1e400`` and blanks around
them, which in the text of a person or of a spreadsheet is more often a slip than a number.
"""

import math
import re

WHOLE = re.compile(r"[+-]?[0-9]{1,4000}")  # Python refuses to convert more than 4,300 digits
DECIMAL = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")


def whole(text: str) -> int:
    """The whole number in a text.

    Raises:
        ValueError: the text is anything else than decimal digits, with or without a sign.
    """
    if not WHOLE.fullmatch(text):
        raise ValueError(f"must be a whole number, got {text[:60]!r}")
    return int(text)


def decimal(text: str) -> float:
    """The number in a text, as in ``-0.25``, ``.5`` or ``1e-3``.

    Raises:
        ValueError: the text is anything else, or no double is that large.
    """
    if not DECIMAL.fullmatch(text) or math.isinf(number := float(text)):
        raise ValueError(f"must be a number, got {text[:60]!r}")
    return number
