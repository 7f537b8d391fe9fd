"""The comparison of methods, read back with Rerun's own reader."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.blueprint.components import PlayState

from chsel.cost.compiled_cost import CompiledCost
from chsel.errors import RecordingError
from chsel.problem.poses import compose, inverse
from chsel.problem.registration_problem import Hypotheses
from chsel.problem.trust import trust_in
from replay.colors import cost_colors, number
from replay.comparing.comparison import common_cost, numbers_under
from replay.events import Event
from replay.mcap.reader import Recording, read_recording
from replay.rerun.comparison_layout import CURVES, entity_names
from replay.rerun.comparison_view import ranked, save_comparison
from replay.rerun.hypotheses import LEVELS
from tests.tools.rrd_rows import Row, read, shown_at

pytestmark = pytest.mark.filterwarnings("ignore:no node of the SDF is deeper")  # a thin box

PAUSED = int(PlayState.Paused.value)
TARGET = "EyeControls3D:look_target"
DISPLAYED = "ViewBlueprint:display_name"
AWKWARD = "Ωther/way, b=½ {x} \\"


@pytest.fixture
def recording(
    make_events: Callable[..., list[Event]], write: Callable[[list[Event]], Path]
) -> Recording:
    """Registrations at steps 1 to 3 of four probes."""
    return read_recording(write(make_events(steps=4)))


@pytest.fixture
def results(recording: Recording) -> dict[str, dict[int, Hypotheses]]:
    """Two methods; the second has nearly the worst pose of the first alone, and lacks step 2."""
    first = {step: recording.hypotheses(step) for step in (1, 2)}
    worst = ranked(first[1], judge_of(recording, 1)).object_from_world[-1:]
    one = Hypotheses(
        object_from_world=worst @ compose(np.eye(3), np.array([0.0, 0.001, 0.0])),
        cost=np.zeros(1),  # by its own measure
        duplicate=np.zeros(1, dtype=bool),
        cell=np.full(1, -1),
        elites=np.zeros((0, 4, 4)),
    )
    return {"chsel": first, AWKWARD: {1: one}}


def judge_of(recording: Recording, step: int) -> CompiledCost:
    return CompiledCost.of(recording.problem(step), common_cost(recording).settings)


@pytest.fixture
def saved(recording: Recording, results: dict[str, dict[int, Hypotheses]], tmp_path: Path) -> Path:
    path = tmp_path / "comparison.rrd"
    save_comparison(path, recording, results)
    return path


def drawn(
    rows: dict[str, list[Row]], name: str, step: int
) -> dict[float, tuple[np.ndarray, tuple[int, ...]]]:
    """World_from_object and colour of the hypotheses of a method, by their cost."""
    found = {}
    for entity in ("best", *(f"cost_step_{n + 1}" for n in range(LEVELS))):
        shown = shown_at(rows[f"/hypotheses/{name}/{entity}"], step)
        for cost, where, turn in zip(
            shown["cost"],
            shown["InstancePoses3D:translations"],
            shown["InstancePoses3D:mat3x3"],
            strict=True,
        ):
            if not np.isnan(cost):
                color = tuple(shown["Mesh3D:albedo_factor"][0].to_bytes(4))[:3]
                found[cost] = compose(np.reshape(turn, (3, 3)).T, np.array(where)), color
    return found


def test_the_scene_is_there_once_and_the_hypotheses_for_each_method(saved: Path) -> None:
    rows = read(saved)
    roots = {entity.split("/")[1] for entity in rows}
    assert roots == {"__properties", "scene", "legend", "hypotheses", "summary", "curves"}
    assert len(rows["/scene/object"]) == 1
    assert [times["probe"] for times, _ in rows["/scene/free/new"]] == [0, 1, 2]
    names = {entity.split("/")[2] for entity in rows if entity.startswith("/hypotheses/")}
    assert names == set(entity_names(["chsel", AWKWARD]).values())


def test_hypotheses_stand_at_their_poses_with_the_costs_of_one_judge(
    saved: Path, recording: Recording, results: dict[str, dict[int, Hypotheses]]
) -> None:
    rows = read(saved)
    names = entity_names(list(results))
    judge = judge_of(recording, 1)
    for label in results:
        found = results[label][1]
        distinct = found.object_from_world[~found.duplicate]
        shown = drawn(rows, names[label], 1)
        expected = dict(zip(judge.evaluate(distinct).tolist(), inverse(distinct), strict=True))
        assert sorted(shown) == sorted(expected)
        for cost, pose in expected.items():
            np.testing.assert_allclose(shown[cost][0], pose, atol=1e-6)


def test_one_scale_colours_all_methods_of_a_step(saved: Path, results: dict[str, Any]) -> None:
    rows = read(saved)
    both = [drawn(rows, name, 1) for name in entity_names(list(results)).values()]
    costs = [cost for shown in both for cost in shown]
    low, high = min(costs), max(costs)
    for shown in both:
        for cost, (_, color) in shown.items():
            level = min(int(LEVELS * np.log(cost / low) / np.log(high / low)), LEVELS - 1)
            assert color == tuple(cost_colors((level + 0.5) / LEVELS))
    best = [shown[min(shown)][1] for shown in both]
    assert best[0] != best[1]
    labels = shown_at(rows["/legend/cost"], 1)["Points2D:labels"]
    assert (labels[0], labels[2]) == (number(low), number(high))


def test_a_step_without_a_result_hides_the_method_and_says_so(
    saved: Path, results: dict[str, Any]
) -> None:
    rows = read(saved)
    chsel, other = entity_names(list(results)).values()
    assert drawn(rows, other, 2) == {}
    assert len(drawn(rows, chsel, 2)) == 3
    assert shown_at(rows[f"/summary/{other}/text"], 2)["Points2D:labels"] == ["no result"]
    assert "3 of 5 drawn" in shown_at(rows[f"/summary/{chsel}/text"], 2)["Points2D:labels"][0]


def test_curves_are_the_numbers_of_the_table(
    saved: Path, recording: Recording, results: dict[str, dict[int, Hypotheses]]
) -> None:
    rows = read(saved)
    name = entity_names(list(results))["chsel"]
    for step in (1, 2):
        judge = judge_of(recording, step)
        numbers = numbers_under(judge, results["chsel"][step], recording.start)
        numbers["log10_best_cost"] = np.log10(numbers["best_cost"])
        numbers["log10_median_cost"] = np.log10(numbers["median_cost"])
        numbers["spread"] = trust_in(recording.problem(step), results["chsel"][step]).spread
        for curve, title in CURVES.items():
            shown = shown_at(rows[f"/curves/{curve}/{name}"], step)
            unit = 1e3 if "[mm]" in title else 180.0 / np.pi if "[°]" in title else 1.0
            assert shown["Scalars:scalars"] == [pytest.approx(unit * numbers[curve], rel=1e-9)]
            assert shown["SeriesLines:names"] == ["chsel"]
        units = {name: title[-4:] for name, title in CURVES.items() if title.endswith("]")}
        assert {name for name, unit in units.items() if unit == "[mm]"} == {
            "spread",
            "best_position_error",
            "closest_position_error",
        }
        assert len(units) == 5


def test_it_opens_at_the_first_compared_step_with_all_that_was_known_by_then(
    recording: Recording, results: dict[str, dict[int, Hypotheses]], tmp_path: Path
) -> None:
    path = tmp_path / "late.rrd"
    save_comparison(path, recording, {"chsel": {2: results["chsel"][2]}})
    panel = {k: v for _, row in read(path, blueprint=True)["/time_panel"] for k, v in row.items()}
    assert panel["TimePanelBlueprint:timeline"] == ["registration"]
    assert panel["TimePanelBlueprint:play_state"] == [PAUSED]
    rows = read(path)
    assert [times["registration"] for times, _ in rows["/scene/free/new"]] == [2, 2, 2]
    assert {times["registration"] for times, _ in rows["/curves/best_cost/chsel"][1:]} == {2}


def test_the_eye_of_every_view_turns_to_the_sets_compared(
    recording: Recording, results: dict[str, dict[int, Hypotheses]], tmp_path: Path
) -> None:
    found = results["chsel"][1]
    places = np.tile([0.2, 0.2, 0.2], (len(found.cost), 1))
    near = compose(inverse(found.object_from_world)[:, :3, :3], places)
    near_one_place = {1: dataclasses.replace(found, object_from_world=inverse(near))}
    path = tmp_path / "a.rrd"
    recording.start = dataclasses.replace(recording.start, world_from_object=None)
    save_comparison(path, recording, {"a": near_one_place, "b": near_one_place})
    eyes = [row for rows in read(path, blueprint=True).values() for _, row in rows if TARGET in row]
    assert len(eyes) == 2
    size = np.linalg.norm(recording.start.mesh.extents)
    for eye in eyes:
        (target,), (position,) = eye[TARGET], eye["EyeControls3D:position"]
        np.testing.assert_allclose(target, (0.2, 0.2, 0.2), atol=size / 2)
        assert size < np.linalg.norm(np.subtract(position, target)) < 2.0 * size


def test_it_ends_at_the_last_compared_step(
    recording: Recording, results: dict[str, dict[int, Hypotheses]], saved: Path
) -> None:
    assert recording.steps == (1, 2, 3)
    probes = {times.get("probe", 0) for rows in read(saved).values() for times, _ in rows}
    assert probes == {0, 1, 2}


@pytest.mark.parametrize("pose_known", [True, False])
@pytest.mark.parametrize(("count", "columns"), [(1, 1), (4, 4), (7, 3)])
def test_each_method_has_a_view_of_the_scene_and_of_its_hypotheses(
    recording: Recording, tmp_path: Path, count: int, columns: int, pose_known: bool
) -> None:
    if not pose_known:
        recording.start = dataclasses.replace(recording.start, world_from_object=None)
    found = {1: recording.hypotheses(1)}
    labels = [f"method {n}" for n in range(count)]
    save_comparison(tmp_path / "a.rrd", recording, dict.fromkeys(labels, found))
    rows = read(tmp_path / "a.rrd", blueprint=True)
    values = {
        entity: {k: v for _, row in of for k, v in row.items()} for entity, of in rows.items()
    }
    views = {
        row[DISPLAYED][0]: values[f"{entity}/ViewContents"]["ViewContents:query"]
        for entity, row in values.items()
        if row.get("ViewBlueprint:class_identifier") == ["3D"]
    }
    names = entity_names(labels)
    assert views == {label: ["$origin/**", f"/hypotheses/{names[label]}/**"] for label in labels}
    titles = {row[DISPLAYED][0] for row in values.values() if DISPLAYED in row}
    assert ("Rotation error of the best [°]" in titles) is pose_known
    assert "log₁₀ best cost" in titles
    grid = [row for row in values.values() if row.get("ContainerBlueprint:grid_columns")]
    assert [row["ContainerBlueprint:grid_columns"] for row in grid] == [[columns]]


def test_labels_become_names_that_differ_and_that_paths_take_as_they_are() -> None:
    names = entity_names(["a b", "a/b", "a,b", "", "é", "x" * 90, "x" * 91, "icp-2"])
    assert len(set(names.values())) == len(names)
    assert all(name and name.replace("-", "").replace("_", "").isascii() for name in names.values())
    assert not any(set(name) & set(" /,.{}\\\"'") for name in names.values())
    assert names["a b"] == "a_b"
    assert names["icp-2"] == "icp-2"


def test_ranking_sorts_all_that_belongs_to_a_hypothesis(recording: Recording) -> None:
    found = recording.hypotheses(1)
    judge = judge_of(recording, 1)
    again = ranked(found, judge)
    order = np.argsort(judge.evaluate(found.object_from_world))
    assert (np.diff(again.cost) >= 0.0).all()
    assert again.cost.tobytes() == judge.evaluate(again.object_from_world).tobytes()
    np.testing.assert_array_equal(again.object_from_world, found.object_from_world[order])
    np.testing.assert_array_equal(again.duplicate, found.duplicate[order])
    np.testing.assert_array_equal(again.cell, found.cell[order])
    assert order.tolist() != list(range(len(order)))


def test_mistakes_are_named_and_leave_nothing(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    found = recording.hypotheses(1)
    with pytest.raises(RecordingError, match="no result to compare; accepted: at least one"):
        save_comparison(path, recording, {"chsel": {}})
    with pytest.raises(RecordingError, match="no registration problem of step 9; accepted: 1, 2"):
        save_comparison(path, recording, {"chsel": {9: found}})
    with pytest.raises(RecordingError, match=r"cannot be written .*accepted: a new \.rrd"):
        save_comparison(tmp_path / "no folder" / "a.rrd", recording, {"chsel": {1: found}})
    assert not path.exists()
    path.write_bytes(b"mine")
    with pytest.raises(RecordingError, match=r"a\.rrd exists"):
        save_comparison(path, recording, {"chsel": {1: found}})
    assert path.read_bytes() == b"mine"
