"""A depth camera that looks at the workspace: the rays of its pixels are free."""

from __future__ import annotations

from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.sensing.depth_camera import PinholeCamera, occlusion_edges
from chsel.sensing.free_space import FreeGrid
from chsel.sensing.regions import depth_regions, speckle_free
from replay.events import SensorImage
from runners.sensors.cell import Cell
from runners.sensors.depth_source import DepthSource, View, intrinsics_of, recorded
from runners.sensors.messages import ImageMessage
from runners.sensors.rig import CameraRig
from runners.sensors.tally import Tally

_EARLY = 0.95  # of the interval between two images: stamps are not exact


class DepthCamera:
    """Marks what it sees through (CHSEL, Sec. V-B: rays to 95 % of the depth)."""

    def __init__(self, rig: CameraRig, camera: PinholeCamera, cell: Cell) -> None:
        self._rig, self._cell = rig, cell
        self._source = DepthSource(rig, camera, cell)
        free = cell.free
        several = rig.views > 1
        self._own = FreeGrid(free.workspace, cell.spacing, views=rig.views) if several else None
        self._last_time: int | None = None
        self._last: tuple[View, BoolArray] | None = None

    def take(self, time: int, message: ImageMessage, tally: Tally) -> None:
        """Use an image of the current probe, unless it comes too soon after the last one."""
        tally.images += 1
        if self._too_soon(time):
            tally.spared += 1
            return
        view = self._source.view(time, message, tally)
        if view is None:
            return
        counts = view.valid
        if self._rig.edge is not None:
            edges = occlusion_edges(
                view.metres, view.valid, self._rig.edge, reach=self._rig.edge_reach
            )
            tally.edges += int(edges.sum())
            counts = view.valid & ~edges
        if not counts.any():
            tally.unusable += 1
            self._cell.remarks.warn(f"{self._rig.name}: an image without a pixel that counts")
            return
        self._mark(view, self._ends(view, counts, tally), counts, tally)
        tally.used += 1
        self._last_time, self._last = time, (view, counts)

    def image(self, step: int) -> SensorImage | None:
        """The last image since the last call, with the pixels whose rays are free."""
        if self._last is None:
            return None
        (view, counts), self._last = self._last, None
        values, unit = recorded(view.metres, view.valid)
        return SensorImage(
            step,
            self._rig.name,
            "depth",
            values,
            unit,
            counts,
            intrinsics_of(self._source.camera),
            view.world_from_camera,
        )

    def _ends(self, view: View, counts: BoolArray, tally: Tally) -> FloatArray:
        """Depths (H, W) up to which rays are free: of speckles the least of what is around them."""
        gate = self._cell.gate
        regions = depth_regions(view.metres, counts, self._source.camera, gate.jump)
        ends, small = speckle_free(view.metres, view.valid, regions, gate.speckle)
        tally.small += small
        return ends

    def _too_soon(self, time: int) -> bool:
        if self._rig.rate is None or self._last_time is None:
            return False
        return 0 <= time - self._last_time < _EARLY * 1e9 / self._rig.rate

    def _mark(self, view: View, ends: FloatArray, counts: BoolArray, tally: Tally) -> None:
        with self._cell.free.by(tally) as grid:
            target = grid if self._own is None else self._own
            arguments = (ends, self._source.camera, view.world_from_camera, counts)
            if self._rig.rays == "scaled_images":
                target.scaled_images(*arguments)
            else:
                target.from_depth(*arguments, fraction=self._rig.fraction)
            if self._own is not None:
                grid.at(self._own.new())
