"""Points on the object that the pads touched, and those that a person annotated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.streams import Purpose, StreamKey
from chsel.sensing.contact_sensing import contact_subset, share
from runners.sensors.cell import RobotCell
from runners.sensors.depth_camera import View
from runners.sensors.pad import Imprint, Pad
from runners.sensors.rig import Rig
from runners.sensors.session_report import Counts


@dataclass(frozen=True, eq=False)
class PushEnd:
    """Points (N, 3) of all membranes in the world then, N > 0, and world_from_hand (4, 4)."""

    membranes: FloatArray
    world_from_hand: FloatArray

    def foremost_mean(self, count: int) -> FloatArray:
        """The mean (1, 3) of the `count` points that lie furthest along the hand's z axis."""
        ahead = self.membranes @ self.world_from_hand[:3, 2]
        foremost = np.argsort(-ahead, kind="stable")[:count]
        return self.membranes[foremost].mean(axis=0, keepdims=True)


class PushWatch:
    """Keeps of every pad the image in which the hand was furthest."""

    def __init__(self, frame: str, cell: RobotCell) -> None:
        """frame: of the hand, z pointing forward."""
        self._frame, self._cell = frame, cell
        self._furthest: dict[str, tuple[float, FloatArray, Pad, View]] = {}

    def take(self, time: int, name: str, pad: Pad, view: View) -> None:
        """An image of the pad called `name`, between the probe's begin and end."""
        pose = self._cell.world_from(self._frame, time, "hand")
        if pose is None:
            return
        advance = float(pose[:3, 2] @ pose[:3, 3])
        if name not in self._furthest or advance > self._furthest[name][0]:
            self._furthest[name] = (advance, pose, pad, view)

    def next(self) -> PushEnd | None:
        """The end of the push, None if no membrane was seen; then the next probe begins."""
        furthest, self._furthest = list(self._furthest.values()), {}
        if not furthest:
            return None
        membranes = np.concatenate([pad.membrane(view) for _, _, pad, view in furthest])
        return PushEnd(membranes, max(furthest, key=lambda entry: entry[0])[1])


@dataclass(frozen=True, eq=False)
class Contacts:
    """Points (C, 3) on the object's surface, and its normals (C, 3), zero where unknown."""

    points: FloatArray
    normals: FloatArray

    @classmethod
    def without_normals(cls, points: FloatArray) -> Contacts:
        """Points (C, 3) alone."""
        return cls(points, np.zeros_like(points))

    @classmethod
    def joined(cls, several: list[Contacts]) -> Contacts:
        """All of several, in their order; of none, no points."""
        nothing = np.zeros((0, 3))
        return cls(
            np.concatenate([nothing, *(some.points for some in several)]),
            np.concatenate([nothing, *(some.normals for some in several)]),
        )


class ContactFinder:
    """Picks a probe's contacts, by the rig's rule and its annotations (CHSEL, Sec. V-B)."""

    def __init__(self, rig: Rig, pads: Mapping[str, Pad], cell: RobotCell, seed: int) -> None:
        self._rig, self._pads, self._cell, self._seed = rig, pads, cell, seed

    def felt(
        self, step: int, imprints: Mapping[str, Imprint], by_sensor: Mapping[str, Counts]
    ) -> Contacts:
        """A seeded subset of the contact pixels of all pads, of those within the workspace."""
        if step in self._rig.annotations.exclude:
            if any(imprint.size for imprint in imprints.values()):
                self._cell.warnings.note(f"probe {step}: contacts left out, as the rig annotates")
            return Contacts.joined([])
        key = StreamKey(self._seed, step)
        found = []
        sizes, rule = [imprint.size for imprint in imprints.values()], self._rig.contact
        shared = rule.per == "contact"
        shares = share(sizes, rule.points) if shared else [rule.points] * len(sizes)
        for index, (name, imprint) in enumerate(imprints.items()):
            most = shares[index]
            chosen = contact_subset(imprint.size, most, key.stream(Purpose.CONTACT_POINTS, index))
            points, normals = self._pads[name].contacts(imprint, chosen)
            kept = self._cell.free.within(points)
            self._cell.warnings.warn(
                f"{name}: a contact left out, as it is out of the workspace", int((~kept).sum())
            )
            by_sensor[name].contacts += int(kept.sum())
            found.append(Contacts(points[kept], normals[kept]))
        return Contacts.joined(found)

    def annotated(self, step: int, push_end: PushEnd | None) -> Contacts:
        """The points that the rig adds to a probe."""
        added = []
        for extra in self._rig.annotations.contacts:
            if extra.probe != step:
                continue
            added.append(np.array(extra.points, dtype=np.float64).reshape(-1, 3))
            if extra.foremost and push_end is not None:
                added.append(push_end.foremost_mean(extra.foremost))
            elif extra.foremost:
                self._cell.warnings.warn(
                    f"probe {step}: no foremost point is added, as no membrane was seen"
                )
        points = np.concatenate([np.zeros((0, 3)), *added])
        kept = self._cell.free.within(points)
        self._cell.warnings.warn(
            f"probe {step}: a contact that the rig adds is left out, as it is out of the workspace",
            int((~kept).sum()),
        )
        contacts = Contacts.without_normals(points[kept])
        if len(contacts.points):
            count = len(contacts.points)
            self._cell.warnings.note(f"probe {step}: {count} contacts added, as the rig annotates")
        return contacts
