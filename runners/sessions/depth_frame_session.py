"""A session of one depth image, as plain files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from chsel.problem.points import KnownPoints, check_points
from replay.events import Logged, Probe, RigDescribed, SensorImage
from replay.files import file_digest
from runners.objects.loader import ObjectModel
from runners.sensors.depth_camera import intrinsics_of, recorded
from runners.sensors.depth_frame import depth_frame_points, read_depth_frame
from runners.sensors.rig import Rig
from runners.sensors.session_report import Report
from runners.sessions.session import SessionEvent

_MANY = 0.2  # of a label's pixels left out: rather a wrong label


class DepthFrameSession:
    """The known points of a depth image as a single probe; see `Session`."""

    def __init__(
        self,
        path: Path,
        rig: Rig,
        object_model: ObjectModel,
        *,
        free_resolution: float,
        images: bool,
    ) -> None:
        self.report = Report()
        self.free_resolution = free_resolution
        self.initial_points = KnownPoints()
        self.count = 1
        self._rig, self._path, self._images = rig, path, images
        self._frame = read_depth_frame(path)
        diameter = object_model.diameter
        self._points = depth_frame_points(
            self._frame, rig, free_resolution=free_resolution, diameter=diameter
        )
        self.workspace = self._points.workspace
        self.world_from_object = self._frame.world_from_object
        check_points(self._points.points, diameter, free_resolution, self.workspace)

    def probes(self) -> Iterator[SessionEvent]:
        """The image, and what follows from it."""
        found, (camera,) = self._points, self._rig.cameras
        self.report.by_probe[0] = {camera.name: found.counts}
        yield RigDescribed(-1, self._rig.name, file_digest(self._path))
        if self._images:
            yield self._image(camera.name)
        count = len(found.points.known)
        text = f"{count} points on the object's surface, {len(found.points.free)} free voxels"
        yield Logged(0, "info", text)
        self.report.lines = list(self._remarks(camera.name))
        yield from (Logged(0, level, text) for level, text in self.report.lines)
        yield Probe(0, "points", found.points)

    def _remarks(self, name: str) -> Iterator[tuple[str, str]]:
        """Levels and texts on what was left out, and on what is suspicious."""
        found, label = self._points, self._points.labelled
        for sensor, counts in ((name, found.counts), ("label", label)):
            if counts is not None and (left_out := counts.left_out()):
                yield "info", f"{sensor}: {left_out}"
        if label is not None and label.small + label.far > _MANY * label.pixels:
            share = 100 * (label.small + label.far) // label.pixels
            yield (
                "warning",
                f"{share} % of the label's pixels are left out, as they are not connected with the "
                "largest region; check label, object_class and gate.jump",
            )
        lower, upper = self.workspace.bounds
        known = found.points.known
        outside = ((known < lower) | (known > upper)).any(axis=1).sum()
        if outside:
            text = f"{outside} of {len(known)} surface points are out of the workspace"
            yield "warning", text

    def close(self) -> None:
        """Nothing is held open."""

    def _image(self, name: str) -> SensorImage:
        depth, frame = np.nan_to_num(self._frame.depth, posinf=0.0, neginf=0.0), self._frame
        values, unit = recorded(depth, depth > 0.0)
        return SensorImage(
            0,
            name,
            "depth",
            values,
            unit,
            self._points.rays,
            intrinsics_of(frame.camera),
            frame.world_from_camera,
        )
