"""The numbers that the report's figures draw, read back from their axes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.container import BarContainer
from matplotlib.patches import PathPatch

from runners.reporting.diversity import picture_of_boxes, picture_over_probes
from runners.reporting.evaluation_folder import open_evaluation
from runners.reporting.method_style import method_styles
from runners.reporting.over_iterations import picture_over_iterations, tables_over_iterations
from runners.reporting.registration_times import picture_of_times, times_of
from tests.runners.drawn_figures import bands_of, legend_of, line_of
from tests.runners.made_up_evaluations import METHODS, row, write_evaluation


def looks(styles: Any) -> dict[str, tuple[object, object, object]]:
    """What a legend must show of methods."""
    return {style.title: (style.color, style.marker, style.line) for style in styles.values()}


def test_pd_over_probes_is_the_median_and_quartiles_of_each_object_and_step(
    tmp_path: Path,
) -> None:
    numbers = {"can": {4: (16.0, 1.0, 4.0), 5: (25.0, 9.0)}, "box": {5: (100.0, 400.0)}}
    rows = [
        row(name, seed, method, step, diversity=factor * value, root=value**0.5, coverage=1.0)
        for name, steps in numbers.items()
        for step, values in steps.items()
        for seed, value in enumerate(values)
        for method, factor in (("chsel", 1.0), ("icp", 3.0))
        if (method, step) != ("icp", 4)  # a gap
    ]
    styles = method_styles(["chsel", "icp"])
    evaluation = open_evaluation(write_evaluation(tmp_path, rows))
    picture = picture_over_probes(evaluation.rows, styles, "pd")
    figure = picture.figure
    box, can = figure.axes
    assert [box.get_title(), can.get_title()] == ["box", "can"]
    assert bands_of(can, styles["chsel"]) == {4.0: (2.5, 4.0, 10.0), 5.0: (13.0, 17.0, 21.0)}
    assert bands_of(can, styles["icp"]) == {5.0: (39.0, 51.0, 63.0)}
    assert bands_of(box, styles["chsel"]) == {5.0: (175.0, 250.0, 325.0)}
    assert legend_of(figure) == looks(styles)
    assert line_of(can, styles["icp"]).get_marker() == styles["icp"].marker
    of_can = picture.data[picture.data["object"] == "can"].drop(columns="object")
    assert of_can.to_numpy().tolist() == [
        ["chsel", 4, 3, 2.5, 4.0, 10.0],
        ["chsel", 5, 2, 13.0, 17.0, 21.0],
        ["icp", 5, 2, 39.0, 51.0, 63.0],
    ]
    assert box.get_ylabel() == "PD in mm²"


def test_boxes_are_quartiles_with_whiskers_within_one_and_a_half_boxes(
    tmp_path: Path,
) -> None:
    values = {"icp": (1.0, 2.0, 3.0, 4.0, 5.0, 100.0), "chsel": (10.0, 10.0, 11.0, 12.0)}
    rows = [
        row("can", seed, method, 4, diversity=value, root=7.0)
        for method, some in values.items()
        for seed, value in enumerate(some)
    ]
    styles = method_styles(["chsel", "icp"])
    evaluation = open_evaluation(write_evaluation(tmp_path, rows))
    picture = picture_of_boxes(evaluation.rows, styles, "boxes")
    (axes,) = picture.figure.axes
    assert sorted(picture.data["diversity"]) == sorted([*values["icp"], *values["chsel"]])
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["CHSEL", "ICP"]
    boxes = [patch for patch in axes.patches if isinstance(patch, PathPatch)]
    assert [to_hex(patch.get_facecolor()) for patch in boxes] == [
        styles[method].color for method in ("chsel", "icp")
    ]
    heights = [patch.get_path().vertices[:, 1] for patch in boxes]
    assert [(part.min(), part.max()) for part in heights] == [(10.0, 11.25), (2.25, 4.75)]
    segments = {
        tuple(map(float, line.get_ydata())) for line in axes.lines if len(line.get_xdata()) == 2
    }
    whiskers = {(10.0, 10.0), (11.25, 12.0), (2.25, 1.0), (4.75, 5.0)}  # 5 <= 4.75 + 1.5 * 2.5
    caps = {(12.0, 12.0), (1.0, 1.0), (5.0, 5.0)}
    medians = {(10.5, 10.5), (3.5, 3.5)}
    assert segments == whiskers | caps | medians
    outliers = [line.get_ydata().tolist() for line in axes.lines if line.get_marker() == "D"]
    assert outliers == [[], [100.0]]


def test_bars_of_time_are_means_with_one_standard_deviation(tmp_path: Path) -> None:
    seconds = {"chsel": (0.1, 0.1, 0.1, 0.5), "icp": (0.02, 0.04)}
    rows = [
        row("can", seed, method, 4, seconds=value)
        for method, values in seconds.items()
        for seed, value in enumerate(values)
    ]
    styles = method_styles(list(seconds))
    evaluation = open_evaluation(write_evaluation(tmp_path, rows))
    picture = picture_of_times(times_of(evaluation.rows, styles), styles)
    assert "CHSEL 200 ms, ICP 30 ms" in picture.alt
    (axes,) = picture.figure.axes
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["CHSEL", "ICP"]
    bars = [one.patches[0] for one in axes.containers if isinstance(one, BarContainer)]
    assert [bar.get_width() for bar in bars] == pytest.approx([200.0, 30.0])
    assert [to_hex(bar.get_facecolor()) for bar in bars] == [
        style.color for style in styles.values()
    ]
    assert [text.get_text() for text in axes.texts] == ["200 ms", "30 ms"]
    (ends,) = axes.containers[1].lines[2][0].get_segments()
    deviation = 1e3 * 0.1 * 3.0**0.5  # of 1, 1, 1 and 5: the variance is 3
    # The axis begins at half of the least time.
    np.testing.assert_allclose(ends[:, 0], [max(10.0, 200.0 - deviation), 200.0 + deviation])
    assert picture.data["mean_ms"].tolist() == pytest.approx([200.0, 30.0])
    assert picture.data["deviation_ms"].tolist() == pytest.approx([deviation, 10.0])


def moments(method: str, cost: float) -> list[dict[str, Any]]:
    """Three searches, measured at two iterations."""
    return [
        {
            "configuration": "drill",
            "seed": seed,
            "method": method,
            "step": 4,
            "iteration": iteration,
            "diversity": 10.0 * value,
            "mean_cost": cost * value,
            "best_cost": 0.5,
            "coverage": 1.0,
        }
        for seed, value in enumerate((1.0, 3.0, 8.0))
        for iteration, value in ((0, 2.0 * value), (25, value))
    ]


def test_numbers_over_iterations_are_medians_and_quartiles_and_costs_of_one_kind(
    tmp_path: Path,
) -> None:
    methods = {"chsel": 1.0, "chsel_cma_me": 2.0, "medial_constraint_cma_me": 1000.0}
    rows = [moment for method, cost in methods.items() for moment in moments(method, cost)]
    evaluation = open_evaluation(write_evaluation(tmp_path, [], rows))
    styles = method_styles(list(methods))
    figure = picture_over_iterations(evaluation.iterations, styles).figure
    diversity, cost = figure.axes
    assert diversity.get_ylabel() == "PD in mm²"
    assert cost.get_ylabel() == "mean relaxed cost of the best cells"
    for method in methods:
        assert bands_of(diversity, styles[method]) == {
            0.0: (40.0, 60.0, 110.0),
            25.0: (20.0, 30.0, 55.0),
        }
    for method in ("chsel", "chsel_cma_me"):
        factor = methods[method]
        assert bands_of(cost, styles[method]) == {
            0.0: (4.0 * factor, 6.0 * factor, 11.0 * factor),
            25.0: (2.0 * factor, 3.0 * factor, 5.5 * factor),
        }
    # Costs of the Medial Constraint are in m², those of the others are relaxed costs.
    assert len(cost.lines) == len(cost.collections) == 2
    assert legend_of(figure) == looks(styles)
    of_diversity, of_cost = tables_over_iterations(evaluation.iterations, styles)
    assert of_diversity.header == ("iteration", "n", *(style.title for style in styles.values()))
    assert of_cost.header == ("iteration", "n", "CHSEL", "CHSEL (CMA-ME)")
    assert [[cell.text for cell in line] for line in of_cost.rows] == [
        ["0", "3", "6", "12"],
        ["25", "3", "3", "6"],
    ]


def test_a_method_looks_the_same_in_every_figure_and_like_no_other() -> None:
    names = [*METHODS, "chsel@paper", "mine", "icp#small"]
    styles = method_styles(names)
    assert len({style.color for style in styles.values()}) == len(names)
    assert len({style.marker for style in styles.values()}) == len(names)
    assert method_styles(["icp", "svgd"])["icp"] == styles["icp"]
    assert list(method_styles(names[::-1])) == list(styles)
