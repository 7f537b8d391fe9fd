"""The programs and the notebook in examples/ print what they are there to show."""

import json
import os
import re
import runpy
import sys

import pytest

from tests.chsel.samples import REPOSITORY

EXAMPLES = REPOSITORY / "examples"
PRINTED = {
    "own_points.py": r"determined \(1 mode.*\[\[ 0\.76\d -0\.6\d+ +-?0\.\d* +0\.4[45]",
    "own_robot.py": r"touch 2: contact.*stopped by spread: the best pose is off by [0-3]\.\d mm",
    "depth_and_touches.py": r"look.* several modes \(2 modes.*touches: determined \(1 mode",
    "replay_with_another_method.py": r"(step \d, anchored: equal\n){3}.*step 2, icp: determined",
    "go_on.py": r"Friday, step 1: wide.*Monday, step 2: determined.*there, step 1: (wide|several)",
    "judge_a_pose.py": r"five touches, right: undecided.*wide.*xteen touches, right: confirmed.*"
    r"touches, turned: contradicted",
    "two_objects.py": r"touches are of: (mustard, mustard, can, can(, )?){5}\n.*\(450, 100, -?0\)",
    "for_a_planner.py": r"6 touches: wide.*24 touches: determined\n  mode \d, 100%: within [0-4]\.",
    "two_threads.py": r"10 additions, 20 contacts: determined",
    "own_policy.py": r"bonus 0.0: [0-4] of 8 touches.*bonus 0.5: [5-8] of 8 touches",
}


@pytest.mark.parametrize("name", PRINTED)
def test_a_program_shows_what_it_says(name, monkeypatch, capsys):
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.setattr(sys, "argv", [name])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    assert re.search(PRINTED[name], capsys.readouterr().out, re.DOTALL)


def test_the_notebook_goes_from_contacts_to_one_mode(monkeypatch, tmp_path):
    """By way of 3! modes: the three lengths of a box along the three edges of a corner."""
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    notebook = nbformat.read(EXAMPLES / "from_contacts_to_modes.ipynb", as_version=4)
    folders = [str(REPOSITORY), str(EXAMPLES), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, folders)))
    nbclient.NotebookClient(notebook, resources={"metadata": {"path": tmp_path}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    text = "".join(output.get("text", "") for output in outputs)
    assert re.search(r"several modes \(6 modes.*determined.* [01]\.\d mm from the true", text, re.S)
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
    assert "application/vnd.jupyter.widget-view+json" in outputs[-1]["data"]  # the viewer


def test_the_notebook_is_kept_without_the_viewer():
    """Which is 23 MB; CONTRIBUTING.md says how outputs are made without the cell of this tag."""
    notebook = json.loads((EXAMPLES / "from_contacts_to_modes.ipynb").read_text())
    *others, last = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert last["metadata"]["tags"] == ["viewer"]
    assert last["outputs"] == []
    assert all(cell["outputs"] for cell in others)
    assert "widgets" not in notebook["metadata"]
