"""A source whose known points are of one object in an image of a BOP dataset."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from chsel.errors import SettingError
from chsel.problem.pose_prior import prior_from_settings
from chsel.problem.settings import CheckedSettings, not_negative, positive
from runners.objects.loader import ObjectModel
from runners.sensors.bop_scene import bop_depth_file, read_bop_frame
from runners.sensors.rig import Rig
from runners.sessions.sensors import DepthFrameSource, SensorsSettings
from runners.sessions.source import ObjectOrigin, ProbeSource, SourceKind


@dataclass(frozen=True)
class BopSettings(CheckedSettings):
    """An object in an image: object=mesh object.scale=0.001 object.path=.../obj_000005.ply."""

    rig: Rig
    dataset: str | None = None  # folder of the dataset
    scene: Annotated[int | None, not_negative] = None
    image: Annotated[int | None, not_negative] = None
    object_id: Annotated[int | None, not_negative] = None  # as scene_gt.json counts
    instance: Annotated[int, not_negative] = 0  # which of several of this object
    split: str = "test"  # folder of the scenes
    free_resolution: Annotated[float, positive] = 0.01  # side of a free voxel, m
    object_resolution: Annotated[float, positive] | None = None
    """Spacing of the object's SDF grid, m; None: by the object, see `ObjectModel.resolution`."""
    object_padding: Annotated[float, positive] = 0.05  # of the object's SDF grid, m
    start_contacts: Annotated[int, not_negative] = 1  # a registration needs so many contacts
    start_probe: Annotated[int, not_negative] = 0  # and this index of the probe
    images: bool = True  # record the image, too
    prior: Annotated[Any, prior_from_settings] = None  # fields of `chsel.PosePrior`

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("dataset", "scene", "image", "object_id"):
            if getattr(self, name) is None:
                raise SettingError(
                    f"{name} is missing; pass session.{name}=, as the dataset has it"
                )

    @property
    def folder(self) -> Path:
        """The folder of the scene."""
        return Path(self.dataset or "").expanduser() / self.split / f"{self.scene:06d}"


def open_bop(  # noqa: PLR0917
    settings: BopSettings, object_model: ObjectModel | None, seed: int
) -> ProbeSource:
    """Open the source of an image. Raise SessionError if it cannot be used."""
    assert object_model is not None
    assert settings.image is not None
    assert settings.object_id is not None
    frame = read_bop_frame(
        settings.folder,
        settings.image,
        object_id=settings.object_id,
        instance=settings.instance,
    )
    of_sensors = SensorsSettings(
        settings.rig,
        path=str(bop_depth_file(settings.folder, settings.image)),
        free_resolution=settings.free_resolution,
        object_resolution=settings.object_resolution,
        object_padding=settings.object_padding,
        start_contacts=settings.start_contacts,
        start_probe=settings.start_probe,
        images=settings.images,
        prior=settings.prior,
    )
    return DepthFrameSource(of_sensors, object_model, frame=frame)


BOP = SourceKind(
    BopSettings,
    open_bop,
    object=ObjectOrigin.REAL,
    groups=({"presets/rig@rig": "default"}, {"rig": "depth_frame"}),
)
