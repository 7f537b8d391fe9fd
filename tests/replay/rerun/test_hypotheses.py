"""Meshes of hypotheses for the eye."""

from __future__ import annotations

import numpy as np
import trimesh

from replay.rerun.hypotheses import LEVELS, cost_levels
from replay.rerun.meshes import coarsened


def test_a_coarsened_mesh_has_fewer_faces_and_nearly_the_same_shape() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    coarse = coarsened(mesh, 2000)
    assert 400 < len(coarse.faces) <= 2000
    radius = np.linalg.norm(coarse.vertices, axis=1)
    assert radius.min() > 0.097
    assert radius.max() < 0.1001
    assert (coarse.face_normals * coarse.triangles_center).sum(axis=1).min() > 0.0


def test_a_mesh_of_few_faces_stays_as_it_is() -> None:
    mesh = trimesh.creation.box()
    assert coarsened(mesh, 12) is mesh


def test_steps_of_cost_run_from_the_lowest_to_the_highest() -> None:
    assert cost_levels(np.array([1.0, 16.0, 256.0])).tolist() == [0, LEVELS // 2, LEVELS - 1]
    assert cost_levels(np.array([2.0, 2.0])).tolist() == [0, 0]
    assert cost_levels(np.zeros(0)).tolist() == []
