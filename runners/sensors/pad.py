"""A soft-bubble pad: contacts where its membrane gives way, free space within the membrane."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from pathlib import Path

import numpy as np

from chsel.errors import SessionError
from chsel.events import SensorImage
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.poses import apply, inverse, rotated, rotation_angle
from chsel.sensing.contact_sensing import contact_mask, deformation, smooth
from chsel.sensing.depth_camera import (
    PinholeCamera,
    depth_regions,
    main_regions,
    small_regions,
    valid_pixels,
)
from runners.sensors.cell import RobotCell
from runners.sensors.depth_camera import (
    View,
    camera_of,
    check_unit,
    first_images,
    image_topics,
    metres,
    recorded_image,
    view_of,
)
from runners.sensors.first_pass import FirstPass
from runners.sensors.log.images import read_image
from runners.sensors.log.messages import ImageMessage
from runners.sensors.rig import BubbleRig, ContactRig
from runners.sensors.sensor import Sensed
from runners.sensors.session_report import Counts
from runners.sensors.surface_points import SurfacePoints

REACH = 0.1  # m: of the membrane from its camera, for how far a turn moves it


def membrane_reference(
    rig: BubbleRig, samples: list[np.ndarray], *, camera: PinholeCamera, beside: Path
) -> FloatArray:
    """Return depth (H, W) of a pad's untouched membrane, metres, 0 where it is not known.

    By the rig's file, relative to the folder `beside` unless it is found as it stands; or the
    median of images (H, W). Raise SessionError if there are none, or of another size.
    """
    images = samples if rig.kind == "depth" else []
    if rig.reference is not None:
        path = Path(rig.reference).expanduser()
        path = path if path.is_file() else beside / path
        images = [read_image(path, f"reference of {rig.name}")]
    if not images:
        raise SessionError(
            f"{rig.name} has images of {rig.kind} and no reference; accepted: reference=FILE, the "
            "depth of its untouched membrane, or a log of depth that begins before its first probe"
        )
    for image in images:
        if image.shape != (camera.height, camera.width):
            height, width = image.shape
            raise SessionError(
                f"the reference of {rig.name} has {width} x {height} pixels; accepted: those of "
                f"its camera, {camera.width} x {camera.height}"
            )
    depths = np.stack([metres(image, rig.unit) for image in images])
    known = valid_pixels(depths, nearest=rig.range[0], furthest=rig.range[1])
    often = known.mean(axis=0) > 0.5
    if not often.any():
        raise SessionError(
            f"the reference of {rig.name} has no depth between {rig.range[0]:g} and "
            f"{rig.range[1]:g} m (its range)"
        )
    middle = np.ma.median(np.ma.masked_array(depths, ~known), axis=0)
    return np.where(often, np.ma.filled(middle, 0.0), 0.0)


@dataclass(frozen=True, eq=False)
class Imprint:
    """One image of a membrane, in contact or not."""

    view: View  # depth of the membrane as it is
    pressed: FloatArray  # (H, W), smoothed deformation, metres
    touching: BoolArray  # (H, W), pixels in contact

    @property
    def size(self) -> int:
        """Number of pixels in contact."""
        return int(self.touching.sum())

    def outweighs(self, other: Imprint | None) -> bool:
        """Return whether more pixels are in contact, or without any, the membrane gives more."""
        if other is None or self.size != other.size:
            return other is None or self.size > other.size
        return self.size == 0 and bool(self.pressed.max() > other.pressed.max())


class Pad:
    """A sensor whose contact is that of the image with the most pixels in contact (Sec. V-B)."""

    _camera: PinholeCamera
    _cell: RobotCell
    _reference: FloatArray  # (H, W), depth of the untouched membrane, metres, 0 where not known
    _lengths: FloatArray  # (H, W), of the rays to depth 1

    def __init__(self, rig: BubbleRig, contact: ContactRig) -> None:
        self.name = rig.name
        self.topics = image_topics(rig)
        self.frame = rig.frame
        self._rig = rig
        self._contact = contact
        self._last_pose: FloatArray | None = None
        self._best: Imprint | None = None

    def prepare(self, first_pass: FirstPass, cell: RobotCell) -> None:
        """Take the intrinsics and the untouched membrane. Raise SessionError without them."""
        self._cell = cell
        self._camera, lens = camera_of(self._rig, first_pass)
        if lens is not None:
            raise first_pass.error(
                f"camera info of {self.name} names a distortion, which is undone in images of "
                "cameras alone; accepted: rectified images, with rectified: true in the rig",
                self.topics[1],
            )
        if self._rig.kind == "depth":
            check_unit(self._rig, first_pass)
        self._lengths = np.sqrt((self._camera.directions() ** 2).sum(axis=-1))
        images = first_images(self._rig, first_pass)
        begin = first_pass.windows[0].begin
        untouched = [values for time, values in images if time < begin]
        if self._rig.reference is None and self._rig.kind == "depth" and not untouched:
            untouched = [values for _, values in images]
            first_pass.warnings.warn(
                f"{self.name}: no image before the first probe; its reference is made of the first "
                f"{len(untouched)} of the probe"
            )
        self._reference = membrane_reference(
            self._rig, untouched, camera=self._camera, beside=first_pass.folder
        )

    def take(self, time: int, message: ImageMessage, *, counts: Counts, within: bool) -> None:
        """Use an image of the current probe; `within` its begin and end, contacts count."""
        counts.images += 1
        imprint = self._imprint(time, message, counts=counts)
        if imprint is None:
            return
        moved = self._has_moved(imprint.view.world_from_camera)
        if within and imprint.outweighs(self._best):
            self._best = imprint
        if moved:
            self._mark(imprint.view, counts)
        counts.used += within or moved
        counts.spared += not (within or moved)

    def remark(self, total: Counts) -> str:
        """Return what is suspicious about all that it gave; "" if nothing is."""
        if not total.used or total.free or total.contacts:
            return ""
        return (
            f"its {total.used} images give no contact and no free voxel; check its frame, which "
            "must be the optical one (x right, z forward), its pose, range and reference, and the "
            "workspace"
        )

    def finish(self, step: int, counts: Counts) -> Sensed:
        """Return the contact pixels of a probe, and the deformation as an image."""
        best = self._best
        self._best = None
        if best is None:
            return Sensed()
        counts.touching += best.size
        self._mark(best.view, counts)
        return Sensed(candidates=self._contacts(best), image=self._image(step, best))

    def _image(self, step: int, imprint: Imprint) -> SensorImage:
        """Return the deformation with the pixels in contact."""
        valid = imprint.view.valid & (imprint.pressed > 0.0)
        pressed = View(
            imprint.pressed,
            valid,
            camera=self._camera,
            world_from_camera=imprint.view.world_from_camera,
        )
        return recorded_image(
            step, self.name, kind="deformation", view=pressed, mask=imprint.touching
        )

    def _contacts(self, imprint: Imprint) -> SurfacePoints:
        """Return the contact pixels, with the normals of the membrane towards the camera."""
        view = imprint.view
        points = self._camera.back_project(view.metres)[imprint.touching]
        filled = np.where(view.valid, view.metres, self._reference)
        normals = self._normals(smooth(filled, self._contact.filter))[imprint.touching]
        pose = view.world_from_camera
        normals = rotated(pose[:3, :3], normals)
        return SurfacePoints.measured(
            apply(pose, points),
            contact_normals=normals,
            normals=normals,
            degrees=self._rig.normals,
        )

    def _imprint(self, time: int, message: ImageMessage, *, counts: Counts) -> Imprint | None:
        view = view_of(
            message, time, rig=self._rig, camera=self._camera, cell=self._cell, counts=counts
        )
        if view is None:
            return None
        known = self._reference > 0.0
        if self._rig.kind == "deformation":
            measured = known & np.isfinite(view.metres)
            pressed = np.where(measured, view.metres, 0.0)
            depth = self._reference - pressed
            nearest, furthest = self._rig.range
            valid = measured & (depth >= nearest) & (depth <= furthest)
            kept = self._main(depth, valid, counts=counts)
            pressed[valid & ~kept] = 0.0
            valid = kept
            view = View(depth, kept, camera=self._camera, world_from_camera=view.world_from_camera)
        else:
            valid = self._main(view.metres, view.valid & known, counts=counts)
            pressed = deformation(self._reference, view.metres, valid=valid)
        if not valid.any():
            counts.unusable += 1
            self._cell.warnings.warn(f"{self._rig.name}: an image without a pixel that counts")
            return None
        contact = self._contact
        pressed = smooth(pressed, contact.filter)
        touching = contact_mask(
            pressed, quantile=contact.quantile, threshold=contact.threshold, valid=valid
        )
        touching = self._main(view.metres, touching, counts=counts, least=contact.pixels)
        return Imprint(view, pressed, touching=touching)

    def _main(
        self, depth: FloatArray, usable: BoolArray, *, counts: Counts, least: int = 0
    ) -> BoolArray:
        """Return those of pixels (H, W) in regions without a jump of depth that are not too small.

        least: pixels of a region.
        """
        gate = self._cell.gate
        regions = depth_regions(depth, usable, camera=self._camera, jump=gate.jump)
        kept = usable & ~small_regions(regions, least)
        kept[kept] = main_regions(regions[kept], part=gate.part).kept
        counts.small += int((usable & ~kept).sum())
        return kept

    def _mark(self, view: View, counts: Counts) -> None:
        """Mark the pad's inside as free, less half a voxel's diagonal before what it may touch."""
        depth = view.metres - sqrt(0.75) * self._cell.spacing / self._lengths
        inside = view.valid & (depth > 0.0)
        pose = view.world_from_camera
        counts.free += self._cell.free.grid.from_depth(
            depth, self._camera, world_from_camera=pose, mask=inside, fraction=1.0
        )

    def _has_moved(self, pose: FloatArray) -> bool:
        """Return whether the membrane is half a voxel away from where it was last marked."""
        if self._last_pose is not None:
            change = inverse(self._last_pose) @ pose
            distance = np.sqrt((change[:3, 3] ** 2).sum())
            if distance + REACH * rotation_angle(change[:3, :3]) < 0.5 * self._cell.spacing:
                return False
        self._last_pose = pose
        return True

    def _normals(self, depth: FloatArray) -> FloatArray:
        """Return unit normals (H, W, 3) of a depth image, towards the camera; 0 if unknown."""
        points = self._camera.back_project(depth)
        normals = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
        away = (normals * points).sum(axis=-1, keepdims=True) > 0.0
        normals = np.where(away, -normals, normals)
        length = np.sqrt((normals**2).sum(axis=-1, keepdims=True))
        return np.where(length > 0.0, normals / np.where(length > 0.0, length, 1.0), 0.0)
