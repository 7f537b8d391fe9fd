"""Pictures of recordings."""

from __future__ import annotations

from pathlib import Path

import pytest

from chsel.errors import RecordingError
from replay.screenshot import save_screenshot


def test_a_recording_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"recording .*none\.rrd does not exist"):
        save_screenshot(tmp_path / "none.rrd", tmp_path / "out.png")
    assert not (tmp_path / "out.png").exists()
