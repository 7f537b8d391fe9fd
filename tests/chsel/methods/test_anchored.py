"""The contact-anchored search: what it finds, and that odd problems have results."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh

from chsel.errors import ChselError, SettingError
from chsel.methods.anchored.anchor_sampling import most_informative_first
from chsel.methods.anchored.anchored import EFFORTS, Anchored, AnchoredSettings, Effort
from chsel.methods.anchored.energy import Energy
from chsel.numerics.arrays import FloatArray
from chsel.numerics.threads import threads
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import ObjectSymmetry
from chsel.problem.online_registration import pose_problem
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import Poses, apply, check_rigid, inverse
from chsel.problem.registration_problem import Hypotheses, NullObserver, RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import PlaneSettings, origin_bounds, search_space
from chsel.problem.settings import build_settings, settings_mapping
from chsel.problem.streams import StreamKey
from tests.chsel.methods.l_shape import GRID, SIDE, STANDING, TRUTH, WORKSPACE, known_points

EFFORT = Effort(
    samples=4000,
    kept=24,
    first_steps=5,
    refined=12,
    steps=8,
    descents=8,
    descent_moves=30,
    chains=12,
    moves=60,
    polished=4,
    polish_moves=40,
)
POINTS = known_points(TRUTH, 40)
FEW = replace(POINTS, known=POINTS.known[:2], known_sdf=None)
INEXACT = replace(  # by 2 mm
    POINTS, known=POINTS.known + np.random.default_rng(1).normal(0.0, 0.002, POINTS.known.shape)
)
INSIDE = apply(TRUTH, np.array([[0.03, 0.03, 0.03], [0.15, 0.03, 0.025]]))


def anchored(effort: Effort = EFFORT, **changes: Any) -> Anchored:
    return Anchored(AnchoredSettings(effort=effort, **changes))


def posed(
    method: Anchored,
    points: KnownPoints = POINTS,
    previous: Hypotheses | None = None,
    workspace: Workspace = WORKSPACE,
    sdf: SdfGrid = GRID,
) -> RegistrationProblem:
    key = StreamKey(3, 1)
    return pose_problem(sdf, points, workspace, SIDE, key, method.online, previous)


def energies_of(
    method: Anchored, problem: RegistrationProblem, object_from_world: FloatArray
) -> FloatArray:
    """Energies (B,) of transforms, as the method's settings have them."""
    settings = method.settings
    space = search_space(settings.plane, problem.sdf)
    bounds = origin_bounds(problem.workspace, space, settings.anchors.margin)
    known, tolerance = most_informative_first(problem.points), settings.penetration_tolerance
    return Energy(problem, known, space, tolerance, bounds).of(Poses.of(object_from_world))


def registered(method: Anchored, problem: RegistrationProblem) -> Hypotheses:
    """The result, found to be whole: as many rigid poses as E_0 has, with their energies."""
    found = method.register(problem)
    assert len(found.object_from_world) == len(problem.initial_set)
    check_rigid("hypotheses", found.object_from_world)
    check_rigid("elites", found.elites)
    assert np.isfinite(found.cost).all()
    assert (np.diff(found.cost) >= 0.0).all()
    energies = energies_of(method, problem, found.object_from_world)
    np.testing.assert_allclose(found.cost, energies, rtol=1e-9, atol=1e-9)
    return found


class Rounds(NullObserver):
    """Counts what is done, and spoils what it is shown."""

    def __init__(self) -> None:
        self.stages: list[str] = []

    def progress(self, stage: str, iteration: int, total: int) -> None:
        self.stages.append(stage)

    def trace(self, stage: str, iteration: int, vectors: FloatArray, cost: FloatArray) -> None:
        vectors[:], cost[:] = np.nan, np.nan


class Costs(NullObserver):
    """Keeps the costs of every stage."""

    def __init__(self) -> None:
        self.cost: dict[str, FloatArray] = {}

    def trace(self, stage: str, iteration: int, vectors: FloatArray, cost: FloatArray) -> None:
        self.cost[stage] = cost


def test_the_object_is_found_where_it_was_touched() -> None:
    method = anchored()
    found = registered(method, posed(method))
    position, rotation = pose_errors(found.object_from_world[:1], TRUTH, ObjectSymmetry())
    assert position[0] < 0.005
    assert rotation[0] < 0.05
    assert found.distinct == 30


def test_results_depend_on_nothing_but_the_problem() -> None:
    method = anchored()
    first = method.register(posed(method))
    watcher = Rounds()
    with threads(2):
        assert method.register(posed(method), watcher).digest == first.digest
    with threads(1):
        assert method.register(posed(method)).digest == first.digest
    assert watcher.stages == ["sample", "fit", "descend", "search", "spread"]
    other = replace(posed(method), key=StreamKey(4, 1))
    assert method.register(other).digest != first.digest


def test_few_contacts_leave_many_distinct_poses() -> None:
    method = anchored()
    found = registered(method, posed(method, FEW))
    assert found.distinct == 30
    spread = np.ptp(inverse(found.object_from_world)[:, :3, 3], axis=0)
    assert spread.max() > 0.03


@pytest.mark.parametrize("points", [FEW, INEXACT], ids=["few", "inexact"])
def test_candidates_are_below_the_limit_but_for_some_chains(points: KnownPoints) -> None:
    for share, beyond in ((0.0, 0.0), (0.5, 0.001), (1.0, 0.001)):
        method, seen = anchored(outer_share=share, outer_noise=2.0), Costs()
        found = method.register(posed(method, points), seen)
        limit = max(0.0005, 1.3 * seen.cost["descend"].min() + 0.00025)
        assert seen.cost["spread"].max() <= limit + beyond
        assert (seen.cost["spread"].max() > limit) == (share > 0.0)
        assert found.cost.max() <= limit + beyond
        assert found.cost.min() <= limit


def test_the_archive_leads_on_to_the_next_step() -> None:
    method = anchored()
    first = method.register(posed(method, FEW))
    assert first.archive is not None
    space = search_space(None, GRID)
    np.testing.assert_array_equal(first.elites, space.poses(first.archive.solutions).matrices)
    problem = posed(method, previous=first)
    np.testing.assert_array_equal(problem.low_cost_set, first.elites)
    np.testing.assert_array_equal(problem.initial_set, first.object_from_world)
    again = posed(method, FEW, previous=first)
    assert method.register(again).cost[0] <= first.cost[0] + 1e-12


def test_a_good_pose_of_the_last_step_is_not_lost() -> None:
    """Even if hardly any samples are drawn."""
    method = anchored(replace(EFFORT, samples=10))
    problem = replace(posed(method), low_cost_set=inverse(TRUTH)[None])
    best = registered(method, problem).object_from_world[:1]
    position, _ = pose_errors(best, TRUTH, ObjectSymmetry())
    assert position[0] < 0.005


@pytest.mark.parametrize(
    "points",
    [
        KnownPoints(free=POINTS.free),
        KnownPoints(free=POINTS.free[:1]),
        KnownPoints(occupied=INSIDE, known=POINTS.known[:3]),
        KnownPoints(occupied=INSIDE),
        KnownPoints(known=POINTS.known[:1]),
        KnownPoints(known=np.repeat(POINTS.known[:1], 20, axis=0)),
        KnownPoints(known=POINTS.known[:4], known_sdf=np.array([0.05, -0.01, 0.0, 0.3])),
        known_points(TRUTH, 400),
        KnownPoints(free=POINTS.free + 1e6, known=POINTS.known + 1e6),
        KnownPoints(free=np.array([[1e200, 0.0, 0.0]]), known=np.array([[1e150, 0.0, 0.0]])),
        KnownPoints(free=POINTS.known, known=POINTS.known),
    ],
    ids=[
        "free",
        "one voxel",
        "occupied and contacts",
        "occupied",
        "one contact",
        "one place",
        "depths",
        "hundreds",
        "far",
        "vast",
        "contradictory",
    ],
)
def test_odd_points_have_results(points: KnownPoints) -> None:
    method = anchored()
    registered(method, posed(method, points))


@pytest.mark.parametrize(
    "workspace",
    [
        Workspace((0.2, 0.1, 0.3), (0.201, 0.101, 0.301)),
        Workspace((50.0, 50.0, 50.0), (51.0, 51.0, 51.0)),
        Workspace((1e6, 1e6, 1e6), (1e6 + 1.0, 1e6 + 1.0, 1e6 + 1.0)),
        Workspace((-1e6, -1e6, -1e6), (1e6, 1e6, 1e6)),
    ],
    ids=["tiny", "elsewhere", "far", "vast"],
)
def test_odd_workspaces_have_results(workspace: Workspace) -> None:
    method = anchored()
    registered(method, posed(method, workspace=workspace))


@pytest.mark.parametrize("count", [1, 700])
def test_as_many_hypotheses_come_as_are_wanted(count: int) -> None:
    method = anchored()
    problem = posed(method, FEW)
    initial = np.resize(problem.initial_set, (count, 4, 4))
    found = registered(method, replace(problem, initial_set=initial))
    assert found.distinct == count


def test_on_a_plane_every_hypothesis_stands_on_it() -> None:
    plane = PlaneSettings(plane_height=0.3)
    method = anchored(plane=plane)
    found = registered(method, posed(method, known_points(STANDING, 40)))
    space = search_space(plane, GRID)
    again = space.poses(space.encode(Poses.of(found.object_from_world))).matrices
    np.testing.assert_allclose(again, found.object_from_world, atol=1e-12)
    np.testing.assert_allclose(inverse(found.object_from_world)[:, 2, 3], 0.3, atol=1e-3)
    position, rotation = pose_errors(found.object_from_world[:1], STANDING, ObjectSymmetry())
    assert position[0] < 0.01
    assert rotation[0] < 0.05


def test_on_a_plane_starts_off_it_count_by_where_they_stand() -> None:
    """One that fits where the object cannot be does not keep those out that fit on the plane."""
    method = anchored(plane=PlaneSettings(plane_height=0.2))
    problem = replace(posed(method), initial_set=np.tile(inverse(TRUTH), (5, 1, 1)))
    found = registered(method, problem)
    assert found.archive is not None
    costs = energies_of(method, problem, found.elites)
    np.testing.assert_allclose(-found.archive.objectives, costs, rtol=1e-9, atol=1e-9)


def test_rounds_go_on_while_the_best_is_above_and_stop_at_the_budget() -> None:
    contradictory = KnownPoints(known=POINTS.known, known_sdf=np.where(np.arange(40) % 2, 0.04, 0))
    short = EFFORT.samples + 24 * 5 + 12 * 8 + 8 * 30
    rounds = []
    for points, budget in [(contradictory, 0), (contradictory, 2 * short + 1), (POINTS, 3 * short)]:
        watcher, method = Rounds(), anchored(replace(EFFORT, evaluations=budget))
        method.register(posed(method, points), watcher)
        rounds.append(watcher.stages.count("search"))
    assert rounds == [1, 3, 1]


def test_a_limit_below_the_best_still_gives_hypotheses() -> None:
    method = anchored(limit_noise=0.0, limit_ratio=0.5, limit_slack=0.0)
    registered(method, posed(method))


def test_an_object_of_few_nodes_inside_has_results() -> None:
    plate = trimesh.creation.box((0.1, 0.08, 0.011))
    method, grid = anchored(), SdfGrid.from_mesh(plate, 0.01)
    contacts = apply(TRUTH, np.asarray(trimesh.sample.sample_surface(plate, 5, seed=1)[0]))
    registered(method, posed(method, KnownPoints(known=contacts, free=POINTS.free), sdf=grid))


@pytest.mark.filterwarnings("ignore:no node of the SDF:UserWarning")
def test_a_grid_without_a_node_inside_is_one_clear_error() -> None:
    grid = SdfGrid(GRID.origin, 0.01, np.maximum(GRID.values, 0.001), GRID.gradients)
    method = anchored()
    with pytest.raises(ChselError, match="no node of the SDF grid is inside") as raised:
        method.register(posed(method, sdf=grid))
    assert "\n" not in str(raised.value)


def test_energies_beyond_all_numbers_are_an_error_that_says_so() -> None:
    method = anchored()
    with pytest.raises(ChselError, match=r"has a finite cost; accepted"):
        method.register(posed(method, KnownPoints(known=np.array([[1e200, 0.0, 0.0]]))))


def test_settings_survive_a_plain_mapping() -> None:
    for settings in (AnchoredSettings(), anchored().settings):
        assert build_settings(AnchoredSettings, settings_mapping(settings), "method") == settings
    assert set(EFFORTS) == {"small", "medium", "large", "adaptive"}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("samples", 0),
        ("kept", -1),
        ("refined", 0),
        ("descents", 0),
        ("chains", 0),
        ("moves", -1),
        ("polished", -3),
        ("polish_moves", -1),
        ("enough", 0.0),
        ("samples", 10**12),
        ("evaluations", float("nan")),
    ],
)
def test_efforts_out_of_bounds_are_refused(name: str, value: Any) -> None:
    with pytest.raises(SettingError, match=f"^{name} is .*accepted: .*$"):
        replace(Effort(), **{name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("size", "huge"),
        ("noise", 0.0),
        ("penetration_tolerance", -0.001),
        ("limit_noise", float("inf")),
        ("limit_ratio", -1.0),
        ("limit_slack", float("nan")),
        ("outer_share", 1.1),
        ("outer_noise", -1.0),
    ],
)
def test_settings_out_of_bounds_are_refused(name: str, value: Any) -> None:
    with pytest.raises(SettingError, match=f"^{name} is .*accepted: .*$"):
        replace(AnchoredSettings(), **{name: value})


def test_a_measure_that_does_not_fit_the_space_is_refused() -> None:
    archive = replace(AnchoredSettings().archive, measure="plane_angle")
    with pytest.raises(SettingError, match="plane_angle exists only with plane"):
        AnchoredSettings(archive=archive)
