"""Definitions of the plausible set in tables: their names, and that one table never mixes them."""

import numpy as np
import pytest

from chsel.errors import SettingError
from chsel.plausible.evaluation_cost import EvaluationCost
from chsel.plausible.plausible_settings import DEFINITIONS, definition_name, plausible_settings
from chsel.problem.points import KnownPoints
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.settings import settings_mapping
from chsel.problem.streams import StreamKey
from runners.evaluation.metrics import definition_label
from tests.chsel.plausible.scenes import WORKSPACE, ball


def definition(name, **changes):
    """A choice of the command, with its settings changed."""
    values = {**settings_mapping(plausible_settings(name, 1.0)), "epsilon": None}
    return {"name": name, **values, **changes}


def test_every_definition_has_its_own_name_and_changed_ones_have_others():
    assert [definition_label(definition(name)) for name in DEFINITIONS] == list(DEFINITIONS)
    assert [definition_name(plausible_settings(name, 0.02)) for name in DEFINITIONS] == list(
        DEFINITIONS
    )
    changed = [
        definition("default", fill_to=40),
        definition("default", fill_to=41),
        definition("default", epsilon=0.002),
        definition("wide_sums", epsilon=0.002),
    ]
    labels = [definition_label(one) for one in changed]
    assert [label[:-8] for label in labels] == ["default~"] * 3 + ["wide_sums~"]
    assert len(set(labels)) == 4
    disguised = {**definition("paper"), "name": "wide_means"}
    assert definition_label(disguised) == "paper"


@pytest.mark.parametrize(("name", "expected"), [("wide_sums", 0.02), ("wide_means", 0.005)])
def test_wide_definitions_add_up_contacts_or_take_their_mean(name, expected):
    """A ball that is 5 mm off four contacts on its sides."""
    contacts = 0.1 * np.array(
        [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
    )
    points = KnownPoints(known=1.05 * contacts)
    problem = RegistrationProblem(
        ball(0.1, 0.005), points, np.eye(4)[None], WORKSPACE, 0.03, StreamKey(0, 0)
    )
    settings = plausible_settings(name, 0.001)
    cost = EvaluationCost(problem, settings.cost).evaluate(np.eye(4)[None])[0]
    assert cost == pytest.approx(expected, rel=0.02)
    assert settings.fill_to == 300
    assert settings.cost.tolerance == 0.0


def test_a_definition_that_cannot_be_is_named():
    with pytest.raises(SettingError, match=r"definition\.cost: combine is 'medians'"):
        definition_label({"name": "mine", "cost": {"combine": "medians"}})
