"""`make docs` builds the pages as a site, whose reference has all that the library offers."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import chsel
from tests.chsel.samples import REPOSITORY

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed"),
]
SITE = REPOSITORY / "build" / "site"


def test_the_site_is_built_without_a_warning_and_has_every_public_name():
    pytest.importorskip("zensical", reason="the extra docs is not installed")
    given = [f"BIN={Path(sys.executable).parent}", "INSTALL=true", "VENV=build"]
    made = ["make", *given, "-o", "build/constraints.txt", "docs"]
    done = subprocess.run(made, cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "No issues found" in done.stdout + done.stderr
    page = (SITE / "docs" / "api.html").read_text()
    documented_together = {"__version__", "build_method", "build_policy"}
    for name in set(chsel.__all__) - documented_together:
        assert f'id="chsel.{name}"' in page, name
    titles = [item["title"] for item in json.loads((SITE / "search.json").read_text())["items"]]
    assert any("grasp_chance" in title for title in titles)
