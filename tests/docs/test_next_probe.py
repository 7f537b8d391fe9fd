"""docs/next_probe.md: tables have every policy, setting and reason to stop; the program runs."""

import re
from collections.abc import Mapping

import numpy as np
import pytest
import trimesh
import yaml

from chsel.next_probe.decision_problem import STOPS, Actions
from chsel.next_probe.forecast import surprise
from chsel.policies import OURS
from chsel.policies.policy import PolicySettings
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import compose
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.settings import settings_mapping
from tests.docs.page import DOCS, section

PAGE = "next_probe.md"


def cells(title):
    """The rows of the tables of a section, by their first cell, a name in backticks."""
    rows = re.findall(r"^\| `([\w.]+)` \| (.+) \|$", section(PAGE, title), re.MULTILINE)
    return {name: text.split(" | ") for name, text in rows}


def flat(settings, path=""):
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{path}{name}.")
        else:
            yield path + name, value


def test_every_setting_of_all_policies_is_there_with_its_default():
    shown = {name: yaml.safe_load(row[0]) for name, row in cells("Settings").items()}
    settings = dict(flat(settings_mapping(PolicySettings())))
    assert shown == {name: settings[name] for name in shown}
    assert set(settings) - set(shown) == {"actions.reach"}  # a group of its own, named above


@pytest.mark.parametrize(
    ("title", "names"), [("Policies", set(OURS)), ("When to stop", set(STOPS) - {""})]
)
def test_every_policy_and_every_reason_to_stop_is_there(title, names):
    assert set(cells(title)) == names


def test_the_program_runs():
    mesh = trimesh.creation.box(extents=(0.1, 0.1, 0.2))
    starts = np.array([[x, 0.0, -0.4] for x in (-0.1, 0.0, 0.1)])
    actions = Actions(compose(np.tile(np.eye(3), (3, 1, 1)), starts), np.full(3, 0.6))
    contacts = np.array([[0.0, 0.0, -0.1]])
    grid, workspace = SdfGrid.from_mesh(mesh, 0.01), Workspace((-0.2,) * 3, (0.2,) * 3)
    (program,) = re.findall(r"```python\n(.*?)```", (DOCS / PAGE).read_text(), re.DOTALL)
    names = {
        "grid": grid,
        "workspace": workspace,
        "actions": actions,
        "vertices": 0.3 * mesh.vertices,
        "faces": mesh.faces,
        "done": 0,
        "points": KnownPoints(),
        "hypotheses": None,
        "available": np.array([True, True, False]),
        "contacts": contacts,
    }
    exec(program, names)
    decision = names["decision"]
    assert decision.chosen == int(np.argmax(decision.score)) in (0, 1)
    assert decision.score[2] == -np.inf
    assert names["steering"].surprise == surprise(
        names["problem"], decision, PolicySettings().noise, contacts[0]
    )
