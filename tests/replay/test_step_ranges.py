"""Which steps a text names."""

from __future__ import annotations

import pytest

from chsel.errors import SettingError
from replay.arguments import chosen_steps

EXISTING = (2, 3, 5, 8, 9)


@pytest.mark.parametrize(
    ("text", "steps"),
    [
        (None, EXISTING),
        ("5", (5,)),
        ("3..8", (3, 5, 8)),
        ("4..", (5, 8, 9)),
        ("..4", (2, 3)),
        ("..", EXISTING),
        ("9, 2..3", (2, 3, 9)),
        ("3,3..3", (3,)),
        ("-7..3", (2, 3)),
    ],
)
def test_a_text_names_steps_that_exist(text, steps):
    assert chosen_steps(text, EXISTING) == steps


def test_steps_before_the_first_probe_have_numbers_too():
    assert chosen_steps("-1", (-1, 0)) == (-1,)


@pytest.mark.parametrize("text", ["", "a", "1..2..3", "1-2", "3,,5", "1.5", "99999999999"])
def test_other_texts_are_refused(text):
    with pytest.raises(SettingError, match="names no steps; accepted: steps, such as 3, "):
        chosen_steps(text, EXISTING)


@pytest.mark.parametrize("text", ["4", "6..7", "10..", "2,4", "8..3"])
def test_a_step_that_does_not_exist_is_named(text):
    with pytest.raises(SettingError, match=r"there is no step .*; accepted: 2, 3, 5, 8, 9"):
        chosen_steps(text, EXISTING)


def test_nothing_can_be_chosen_of_nothing():
    assert chosen_steps(None, ()) == ()
    with pytest.raises(SettingError, match="accepted: none"):
        chosen_steps("..", ())
