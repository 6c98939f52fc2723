"""Only plain numbers are numbers."""

import pytest

from sofnn_torch import numerals

NO_NUMBERS = [
    "",
    " 1",
    "1 ",
    "1\n",
    "1_0",
    "\u0661",
    "\u00b2",
    "0x10",
    "1e",
    "--1",
    "1,0",
    "one",
    "True",
]


@pytest.mark.parametrize(("text", "number"), [("12", 12), ("-3", -3), ("+0", 0), ("007", 7)])
def test_whole_numbers(text, number):
    assert numerals.whole(text) == number


@pytest.mark.parametrize("text", [*NO_NUMBERS, "1.0", "1e3", "9" * 5000])
def test_what_is_no_whole_number(text):
    with pytest.raises(ValueError, match=r"^must be a whole number, got '.{0,60}'$"):
        numerals.whole(text)


@pytest.mark.parametrize(
    ("text", "number"),
    [("12", 12), ("-0.25", -0.25), ("+.5", 0.5), ("1.", 1), ("25E-2", 0.25), ("1e+2", 100)],
)
def test_decimal_numbers(text, number):
    assert numerals.decimal(text) == number


@pytest.mark.parametrize("text", [*NO_NUMBERS, ".", "nan", "inf", "1e400", "-1e999", "9" * 5000])
def test_what_is_no_decimal_number(text):
    with pytest.raises(ValueError, match=r"^must be a number, got '.{0,60}'$"):
        numerals.decimal(text)
