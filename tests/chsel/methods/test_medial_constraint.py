"""Both methods on the Medial Constraint cost: what they find, and what moves no bit of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from chsel.errors import ChselError, SettingError
from chsel.methods import preset_settings
from chsel.methods.medial_constraint.cma_es import CmaEsSettings
from chsel.methods.medial_constraint.medial_constraint import (
    MedialConstraint,
    MedialConstraintCmaMe,
)
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import ObjectSymmetry
from chsel.problem.online_registration import pose_problem
from chsel.problem.points import KnownPoints
from chsel.problem.poses import inverse
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses, RegistrationProblem
from chsel.problem.search_space import PlaneSettings
from chsel.problem.settings import PRESETS, build_settings, settings_mapping
from chsel.problem.streams import StreamKey
from tests.chsel.methods.l_shape import GRID, SIDE, STANDING, TRUTH, WORKSPACE, known_points

Maker = Callable[[str], Any]
POINTS = known_points(TRUTH, 60)


def plain(preset: str = "default", **changes: Any) -> MedialConstraint:
    return MedialConstraint(replace(preset_settings("medial_constraint", preset), **changes))


def diverse(preset: str = "default", **changes: Any) -> MedialConstraintCmaMe:
    return MedialConstraintCmaMe(
        replace(preset_settings("medial_constraint_cma_me", preset), **changes)
    )


MAKERS: list[Any] = [plain, diverse]


def quick(make: Maker, preset: str = "default") -> Any:
    settings = make(preset).settings
    short: dict[str, Any] = {"cma_es": replace(settings.cma_es, generations=12)}
    if hasattr(settings, "emitter"):
        short["emitter"] = replace(settings.emitter, iterations=12)
    return type(make(preset))(replace(settings, **short))


def posed(
    method: Any, previous: Hypotheses | None = None, points: KnownPoints = POINTS
) -> RegistrationProblem:
    key = StreamKey(3, 1)
    return pose_problem(GRID, points, WORKSPACE, SIDE, key, method.online, previous)


class Watcher:
    """Keeps what it is shown, and scribbles over the arrays."""

    snapshot_interval = 5

    def __init__(self) -> None:
        self.stages: list[tuple[str, int]] = []
        self.traces: list[tuple[str, int, tuple[int, ...], int]] = []
        self.archives: list[ArchiveSnapshot] = []

    def progress(self, stage: str, iteration: int, total: int) -> None:
        self.stages.append((stage, iteration))

    def trace(self, stage: str, iteration: int, vectors: np.ndarray, cost: np.ndarray) -> None:
        self.traces.append((stage, iteration, vectors.shape, len(cost)))
        vectors[:] = np.nan
        cost[:] = np.nan

    def snapshot(self, archive: ArchiveSnapshot) -> None:
        self.archives.append(archive)


@pytest.mark.parametrize("make", MAKERS)
@pytest.mark.parametrize(
    "points",
    [
        KnownPoints(free=POINTS.free),
        KnownPoints(known=POINTS.known[:1]),
        KnownPoints(known=np.array([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [0.3, 0.3, 0.3]])),
        KnownPoints(occupied=POINTS.known[:5]),
        KnownPoints(free=POINTS.free[:1], known=POINTS.known[:4]),
        KnownPoints(free=POINTS.free + 1e6, known=POINTS.known + 1e6),
        KnownPoints(free=[[1e200, 0.0, 0.0]], known=[[1e150, 0.0, 0.0]]),
        KnownPoints(known=POINTS.known[:3], known_sdf=[0.05, -0.01, 0.0]),
    ],
    ids=["free", "one contact", "collinear", "occupied", "one voxel", "far", "vast", "depths"],
)
def test_points_that_tell_little_give_finite_poses(make: Maker, points: KnownPoints) -> None:
    method = quick(make)
    found = method.register(posed(method, points=points))
    assert np.isfinite(found.object_from_world).all()
    assert np.isfinite(found.cost).all()


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("make", MAKERS)
def test_one_hypothesis_is_enough(make: Maker, preset: str) -> None:
    method = quick(make, preset)
    problem = replace(posed(method), initial_set=posed(method).initial_set[:1])
    assert np.isfinite(method.register(problem).object_from_world).all()


@pytest.mark.parametrize("make", MAKERS)
def test_costs_beyond_all_numbers_are_an_error_that_says_so(make: Maker) -> None:
    method = quick(make)
    with pytest.raises(ChselError, match=r"has a finite cost; accepted"):
        method.register(posed(method, points=KnownPoints(known=[[1e200, 0.0, 0.0]])))


@pytest.mark.parametrize("make", MAKERS)
def test_on_a_plane_every_hypothesis_stands_on_it(make: Maker) -> None:
    method = make("default", plane=PlaneSettings(plane_height=0.3))
    found = method.register(posed(method, points=known_points(STANDING, 40)))
    np.testing.assert_allclose(inverse(found.object_from_world)[:, 2, 3], 0.3, atol=1e-3)
    position, rotation = pose_errors(found.object_from_world[:1], STANDING, ObjectSymmetry())
    assert position[0] < 0.01
    assert rotation[0] < 0.05


def test_a_run_from_every_start_is_traced_to_its_end() -> None:
    watcher = Watcher()
    method = plain(cma_es=CmaEsSettings(generations=120))
    method.register(posed(method), watcher)
    assert watcher.traces == [("cma_es", done, (30, 9), 30) for done in (0, 50, 100, 120)]
    assert watcher.stages == [("cma_es", done) for done in (50, 100, 120)]
    assert watcher.archives == []


def test_snapshots_of_the_archive_come_at_start_interval_and_end_and_only_improve() -> None:
    watcher = Watcher()
    method = quick(diverse)
    found = method.register(posed(method), watcher)
    assert [archive.iteration for archive in watcher.archives] == [0, 5, 10, 12]
    coverage = [archive.coverage for archive in watcher.archives]
    assert coverage == sorted(coverage)
    assert coverage[-1] > coverage[0]
    assert found.archive is not None
    assert found.archive.digest == watcher.archives[-1].digest
    assert watcher.stages[-1] == ("cma_me", 12)
    rows = [list(found.archive.cells).index(cell) for cell in found.cell]
    np.testing.assert_array_equal(found.elites[rows], found.object_from_world)


def test_elites_of_the_last_result_enter_the_archive() -> None:
    method = quick(diverse)
    first = method.register(posed(method))
    problem = posed(method, first)
    assert len(problem.low_cost_set) == len(first.elites)
    assert method.register(problem).cost[0] <= first.cost[0] * (1.0 + 1e-9)


def test_the_search_only_lowers_the_best_cost_of_cma_es() -> None:
    settings = quick(diverse).settings
    problem = posed(quick(diverse))
    before = quick(plain).register(problem).cost[0]
    assert diverse(cma_es=settings.cma_es).register(problem).cost[0] <= before * (1.0 + 1e-9)


def test_presets_differ_where_paper_and_code_differ() -> None:
    paper, reference, ours = (
        preset_settings("medial_constraint", preset) for preset in ("paper", "reference", "default")
    )
    assert (paper.cma_es.starts, reference.cma_es.starts) == ("per_start", "single")
    assert (paper.cost.ball_scale, reference.cost.ball_scale) == (1.0, 0.0)
    assert (paper.cost.lookup, ours.cost.lookup) == ("nearest", "trilinear")
    assert preset_settings("medial_constraint_cma_me", "paper").output.shortage == "fewer"


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("make", MAKERS)
def test_settings_survive_a_plain_mapping(make: Maker, preset: str) -> None:
    settings = make(preset).settings
    assert build_settings(type(settings), settings_mapping(settings), "method") == settings


def test_a_measure_that_does_not_fit_the_space_is_refused() -> None:
    archive = replace(preset_settings("medial_constraint_cma_me").archive, measure="plane_angle")
    with pytest.raises(SettingError, match="plane_angle exists only with plane"):
        diverse(archive=archive)
