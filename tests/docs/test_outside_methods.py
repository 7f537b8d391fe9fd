"""docs/outside_methods.md: what stands there is what a user does, and the table has his rows."""

import pyarrow.parquet as parquet
import pytest

from tests.docs.page import commands, shell, write_files

pytestmark = pytest.mark.slow
PAGE = "outside_methods.md"


def test_a_program_that_knows_nothing_of_this_package_is_ranked(tmp_path):
    (program,) = write_files(PAGE, tmp_path)
    assert "chsel" not in program.read_text()
    for command in commands(PAGE):
        done = shell(command, tmp_path)
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    rows = parquet.read_table(tmp_path / "ranking/results.parquet").to_pylist()
    by_method = {(row["method"], row["step"]): row for row in rows}
    assert set(by_method) == {(name, step) for name in ("centred", "icp") for step in (4, 5)}
    for step in (4, 5):
        outside, icp = by_method["centred", step], by_method["icp", step]
        assert outside["status"] == icp["status"] == "ok"
        assert (outside["preset"], outside["hypotheses"]) == ("outside", 30)
        assert (outside["seconds"], outside["best_cost"]) == (None, None)
        assert outside["diversity"] > 0.0
        assert outside["diversity"] != icp["diversity"]
        # All of its positions are the mean contact: less than the object's size from the truth.
        assert 0.0 < outside["position_error"] < 0.5
