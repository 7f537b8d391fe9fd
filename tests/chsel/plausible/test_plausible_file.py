"""Plausible sets written to files, and found again by what they belong to."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chsel.errors import EvaluationError
from chsel.numerics.arrays import FloatArray
from chsel.plausible.plausible_set import (
    PlausibleSet,
    load_plausible,
    plausible_path,
    plausible_set,
    save_plausible,
)
from chsel.plausible.plausible_settings import Offsets, PlausibleSettings, PoseGridSettings
from chsel.problem.poses import apply
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.streams import StreamKey
from tests.chsel.plausible.scenes import ball, scene

SETTINGS = PlausibleSettings(
    epsilon=0.02,
    grid=PoseGridSettings(Offsets(((-0.02, 0.02, 3),), ((0.0, 0.0, 1),), ((0.0, 0.0, 1),)), 20),
)
Made = tuple[RegistrationProblem, FloatArray, PlausibleSet]


@pytest.fixture(scope="module")
def made() -> Made:
    problem, truth = scene(np.random.default_rng(1), ball())
    contact = apply(truth, np.array([[0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]))
    points = replace(problem.points, free=np.zeros((0, 3)), known=contact, known_sdf=None)
    problem = replace(problem, points=replace(points, occupied=np.zeros((0, 3))))
    return problem, truth, plausible_set(problem, truth, SETTINGS)


def test_a_set_is_read_as_it_was_written_and_named_by_its_points(
    made: Made, tmp_path: Path
) -> None:
    problem, truth, found = made
    assert len(found.index) > 3
    assert load_plausible(tmp_path, problem, SETTINGS) is None
    path = save_plausible(tmp_path / "sets", found)
    assert path.name.startswith(problem.points.digest)
    assert path == plausible_path(tmp_path / "sets", problem, SETTINGS)
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    read = load_plausible(path.parent, problem, SETTINGS, world_from_object=truth)
    assert read is not None
    assert read.digest == found.digest
    assert (read.settings, read.seed) == (SETTINGS, 7)
    assert read.true_cost == found.true_cost
    np.testing.assert_array_equal(read.truth, truth)
    with np.load(path, allow_pickle=False) as arrays:
        assert float(arrays["epsilon"]) == 0.02
        np.testing.assert_array_equal(arrays["true_pose"], truth)


def test_other_points_definitions_and_seeds_have_files_of_their_own(
    made: Made, tmp_path: Path
) -> None:
    problem, _, found = made
    path = save_plausible(tmp_path, found)
    more = replace(problem, points=problem.points.merged(problem.points))
    others = [
        (more, SETTINGS),
        (replace(problem, sdf=ball(0.09)), SETTINGS),
        (replace(problem, key=StreamKey(8, 2)), SETTINGS),
        (problem, replace(SETTINGS, epsilon=0.021)),
        (problem, replace(SETTINGS, cost=replace(SETTINGS.cost, tolerance=0.0))),
    ]
    names = {plausible_path(tmp_path, *other).name for other in others}
    assert len(names | {path.name}) == 6
    assert all(load_plausible(tmp_path, *other) is None for other in others)
    later = replace(problem, key=StreamKey(7, 9))
    assert plausible_path(tmp_path, later, SETTINGS) == path


def test_a_file_under_the_wrong_name_is_refused(made: Made, tmp_path: Path) -> None:
    problem, truth, found = made
    path = save_plausible(tmp_path, found)
    more = replace(problem, points=problem.points.merged(problem.points))
    path.rename(plausible_path(tmp_path, more, SETTINGS))
    with pytest.raises(EvaluationError, match="belongs to another known points"):
        load_plausible(tmp_path, more, SETTINGS)
    save_plausible(tmp_path, found)
    moved = truth.copy()
    moved[0, 3] += 0.001
    with pytest.raises(EvaluationError, match="belongs to another true pose"):
        load_plausible(tmp_path, problem, SETTINGS, world_from_object=moved)


def test_every_damage_to_a_file_is_one_line(made: Made, tmp_path: Path) -> None:
    problem, _, found = made
    path = save_plausible(tmp_path, found)
    whole = path.read_bytes()
    stream = np.random.default_rng(0)
    refused = 0
    for n in range(60):
        damaged = bytearray(whole)
        if n % 3:
            damaged[int(stream.integers(len(whole)))] ^= int(stream.integers(1, 256))
        else:
            damaged = damaged[: int(stream.integers(len(whole)))]
        path.write_bytes(damaged)
        try:
            read = load_plausible(tmp_path, problem, SETTINGS)
        except EvaluationError as error:
            refused += "\n" not in str(error)
        else:  # a byte that says nothing, such as a date in the archive
            assert read is not None
            assert read.digest == found.digest
    assert refused > 40  # each in one line; others would have raised something else


def test_what_was_changed_after_it_was_written_is_refused(made: Made, tmp_path: Path) -> None:
    problem, _, found = made
    path = save_plausible(tmp_path, found)
    with np.load(path) as archive:
        arrays = dict(archive)
    for name, value, message in [
        ("cost", arrays["cost"] * 2.0, "does not hold what was written"),
        ("format", np.array(99), "format 99"),
        ("world_from_object", arrays["world_from_object"] * 2.0, "not a rigid transform"),
        ("cost", np.array([object()]), "damaged"),
    ]:
        np.savez(path.open("wb"), **{**arrays, name: value})
        with pytest.raises(EvaluationError, match=message):
            load_plausible(tmp_path, problem, SETTINGS)


def test_a_folder_that_cannot_be_written_is_named(made: Made, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(EvaluationError, match="cannot be written"):
        save_plausible(tmp_path / "file", made[2])
