"""What a run shows on the terminal while it works."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from runners.objects.loader import ObjectConfig
from runners.objects.scans import AssetsConfig
from runners.run.recording import RecordingConfig
from runners.run.scene import PresetName, ProbeConfig, open_scene


def test_the_object_of_a_session_shows_its_size_and_how_far_its_grid_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("chsel.problem.mesh.MANY_FACES", 1000)
    monkeypatch.setattr("chsel.problem.sdf_grid._PART_NODES", 500)
    trimesh.creation.icosphere(subdivisions=3, radius=0.04).export(tmp_path / "ball.ply")
    np.savez(tmp_path / "points.npz", surface=np.eye(3) * 0.04)
    config = ProbeConfig(
        ObjectConfig("ball", 1.0, 0.001, "ball", kind="file", path=str(tmp_path / "ball.ply")),
        {"kind": "points", "path": str(tmp_path / "points.npz"), "object_resolution": 0.02},
        {"name": "chsel"},
        {"name": "grid"},
        PresetName("default"),
        RecordingConfig(),
        AssetsConfig(str(tmp_path), "https://nowhere.example"),
        str(tmp_path),
        seed=0,
        threads=1,
        configuration=None,
    )
    told: list[tuple[str, int, int]] = []
    message = r"mesh file .*ball\.ply has 1,280 faces: making its signed distance grid takes"
    with pytest.warns(UserWarning, match=message):
        scene = open_scene(config, lambda *progress: told.append(progress))
    nodes = scene.sdf.values.size
    stage = "signed distance grid, nodes"
    assert told == [(stage, done, nodes) for done in range(0, nodes, 500)]
    assert len(told) > 1
