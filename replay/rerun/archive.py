"""The archive of quality-diversity search as a heat map over its first two measures."""

from __future__ import annotations

import numpy as np
import rerun as rr

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses
from replay.colors import EMPTY_CELL, TEXT, ColorArray, CostScale, cost_colors, number
from replay.rerun.scene import on_screen, shown_hypotheses

_FLATTEST = 4  # a map wider or higher than this has its shorter side stretched
_MARK = (255, 255, 255)


class ArchiveMap:
    """The map of an archive under the entity `archive`; a unit of the view is one cell."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self.size: tuple[int, int] | None = None  # width and height of the last map, in cells
        self._stream = stream
        self._scale: CostScale | None = None  # of this registration
        self._last: ArchiveSnapshot | None = None

    def start(self) -> None:
        """Start the archive of a registration, without the marks on the last one."""
        self._scale = self._last = None
        self._mark(np.zeros((0, 2)), [])

    def draw(self, step: int, archive: ArchiveSnapshot) -> None:
        """Draw the lowest cost in each cell, empty cells in grey, a caption and ranges of axes."""
        scale = CostScale.of(-archive.objectives)
        if self._scale is not None:
            ends = (scale.low, scale.high, self._scale.low, self._scale.high)
            scale = CostScale.of(ends)
        self._scale, self._last = scale, archive
        costs = lowest_costs(archive)
        height, width = costs.shape
        self.size = width, height
        # The costs lie under the colours, so that the viewer shows them where the mouse points.
        self._stream.log("archive/cost", rr.Image(costs, color_model="L", draw_order=-30.0))
        self._stream.log("archive/colors", rr.Image(heat_map(costs, scale), draw_order=-20.0))
        side = max(width, height)
        labels = rr.Points2D(
            [(width / 2, -0.12 * side), (width / 2, height + 0.03 * side)],
            labels=_texts(step, archive, scale=scale),
            colors=[TEXT],
            radii=on_screen(0.0),
            show_labels=True,
        )
        self._stream.log("archive/text", labels)

    def mark(self, step: int, hypotheses: Hypotheses) -> None:
        """Mark the cells that the hypotheses come from, each with its cost."""
        if self._last is None and hypotheses.archive is not None:
            self.draw(step, hypotheses.archive)
        if self._last is None or self.size is None:
            return
        shown = shown_hypotheses(hypotheses)
        shown = shown[hypotheses.cell[shown] >= 0]
        columns, rows = _places(self._last, hypotheses.cell[shown])
        width, height = self.size
        x = width * (columns + 0.5) / self._last.shape[0]
        y = height * (1.0 - (rows + 0.5) / _rows(self._last))
        costs = hypotheses.cost[shown].tolist()
        self._mark(np.stack([x, y], axis=1), [f"cost {number(cost)}" for cost in costs])

    def _mark(self, places: FloatArray, labels: list[str]) -> None:
        points = rr.Points2D(
            places, labels=labels, show_labels=False, colors=[_MARK], radii=on_screen(2.5)
        )
        self._stream.log("archive/hypotheses", points)


def lowest_costs(archive: ArchiveSnapshot) -> np.ndarray:
    """Return the map (height, width), float32: the lowest cost over other measures, NaN if empty.

    The first measure runs to the right, the second upwards; one measure alone makes a strip.
    """
    columns, rows = _places(archive, archive.cells)
    width = archive.shape[0]
    height = _rows(archive)
    costs = np.full((height, width), np.inf)
    np.minimum.at(costs, (height - 1 - rows, columns), -archive.objectives)
    costs[np.isinf(costs)] = np.nan
    wider, higher = max(1, height // (_FLATTEST * width)), max(1, width // (_FLATTEST * height))
    return np.repeat(np.repeat(costs, higher, axis=0), wider, axis=1).astype(np.float32)


def heat_map(costs: np.ndarray, scale: CostScale) -> ColorArray:
    """Return the picture (height, width, 3) of costs (height, width)."""
    filled = ~np.isnan(costs)
    picture = np.full((*costs.shape, 3), EMPTY_CELL, dtype=np.uint8)
    picture[filled] = cost_colors(scale.fraction(costs[filled]))
    return picture


def _rows(archive: ArchiveSnapshot) -> int:
    return archive.shape[1] if len(archive.shape) > 1 else 1


def _places(archive: ArchiveSnapshot, cells: IntArray) -> tuple[IntArray, IntArray]:
    """Return column and row of cells, along the first two measures."""
    indices = np.unravel_index(cells, archive.shape)
    columns = np.asarray(indices[0], dtype=np.int64)
    rows = np.asarray(indices[1], dtype=np.int64) if len(indices) > 1 else np.zeros_like(columns)
    return columns, rows


def _texts(step: int, archive: ArchiveSnapshot, *, scale: CostScale) -> list[str]:
    """Return the caption with the upward measure, and the label of the one to the right."""
    refinement = f", refinement {archive.refinement}" if archive.refinement else ""
    caption = (
        f"probe {step}, iteration {archive.iteration}{refinement}: {len(archive.cells)} of "
        f"{int(np.prod(archive.shape))} cells filled, cost {number(scale.low)} to "
        f"{number(scale.high)}"
    )
    ranges = zip(archive.measure_names, archive.lower, archive.upper, strict=True)
    across, *others = (f"{name}: {number(low)} to {number(high)}" for name, low, high in ranges)
    upwards = f"\nupwards {others[0]}" if others else ""
    lowest = "".join(f"; lowest over {name}" for name in archive.measure_names[2:])
    return [f"{caption}{upwards}", f"{across}{lowest}"]
