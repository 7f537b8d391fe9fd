"""The pictures of README and docs."""

from __future__ import annotations

import io
import re
import sys

import numpy as np
import pytest
from PIL import Image

from chsel.errors import RecordingError
from runners import gallery
from runners.gallery import PICTURES, REPOSITORY, animation
from runners.reporting.figures import small_png

OF_REPORTS = REPOSITORY / "docs" / "results"


def test_every_picture_shown_is_made_by_the_gallery() -> None:
    pages = [REPOSITORY / "README.md", *(REPOSITORY / "docs").glob("*.md")]
    shown = {
        (page.parent / link).resolve()
        for page in pages
        for link in re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text())
    }
    ours = {path for path in shown if not path.is_relative_to(OF_REPORTS)}
    assert ours == {REPOSITORY / name for name in PICTURES}
    assert all(0 < path.stat().st_size < 1_500_000 for path in ours)


def test_what_is_not_a_picture_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["gallery", "docs/none.png"])
    with pytest.raises(SystemExit) as error:
        gallery.main()
    assert error.value.code == 2
    assert "docs/none.png is not a picture; accepted: replay/" in capsys.readouterr().err


def test_a_command_that_fails_is_named_with_its_reason() -> None:
    with pytest.raises(RecordingError, match=r"runners\.none failed: .*No module named"):
        gallery._run("runners.none")


def test_small_pictures_have_a_palette_and_look_the_same() -> None:
    shades = np.stack(np.meshgrid(*[np.arange(0, 256, 2)] * 2), axis=-1)
    pixels = np.dstack([np.full(shades.shape[:2], 30), shades]).astype(np.uint8)
    pixels[60:63, 60:63] = (255, 60, 90)  # a contact
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, format="png")
    small = Image.open(io.BytesIO(small_png(stream.getvalue())))
    assert (small.format, small.mode) == ("PNG", "P")
    difference = np.abs(np.asarray(small.convert("RGB"), dtype=int) - pixels)
    assert difference.max() < 32
    assert difference[60:63, 60:63].max() < 8


def test_an_animation_shows_each_frame_for_its_time() -> None:
    frames = [Image.new("RGB", (40, 30), (60 * n, 0, 0)) for n in range(3)]
    shown = Image.open(io.BytesIO(animation(frames, [400, 300, 2500])))
    assert (shown.format, shown.size, shown.n_frames) == ("WEBP", (40, 30), 3)  # type: ignore[attr-defined]
    times = []
    for n in range(3):
        shown.seek(n)
        shown.load()
        times.append(shown.info["duration"])
        red = np.asarray(shown.convert("RGB"))[..., 0]
        assert np.abs(red.astype(int) - 60 * n).max() < 12
    assert times == [400, 300, 2500]
    assert shown.info["loop"] == 0
