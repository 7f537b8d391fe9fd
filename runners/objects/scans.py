"""Scans of the YCB Object and Model Set: where they lie, what they must be, and their download."""

from __future__ import annotations

import os
import re
import tarfile
import tempfile
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO, cast

import numpy as np

from chsel.errors import ChselError, MeshError, SettingError
from chsel.problem.mesh import load_mesh

# By official folder: the choice's name, and the scan's extents in metres.
SCANS = {
    "035_power_drill": ("drill", (0.1605, 0.1210, 0.1915)),
    "006_mustard_bottle": ("mustard", (0.0829, 0.0940, 0.1875)),
    "048_hammer": ("hammer", (0.1064, 0.3326, 0.0447)),
    "003_cracker_box": ("cracker_box", (0.0900, 0.1678, 0.2384)),
    "010_potted_meat_can": ("spam_can", (0.0967, 0.0884, 0.0852)),
    "050_medium_clamp": ("clamp", (0.0435, 0.0625, 0.0835)),
}
EXTENT_TOLERANCE = 0.01  # of the expected extent
URL = "http://ycb-benchmarks.s3-website-us-east-1.amazonaws.com/data/google"
TIMEOUT = 30.0  # seconds without a byte of a download
RESOLUTION = "google_16k"
MESH_FILE = "nontextured.ply"


class DownloadError(ChselError):
    """A scan could not be downloaded, or is not what was asked for."""


@dataclass(frozen=True)
class AssetsConfig:
    """Where scans lie, and where they come from."""

    dir: str  # the folder; ~ is the home folder
    url: str  # address of the folder of the official archives

    def __post_init__(self) -> None:
        if not self.dir.strip():
            raise SettingError("dir is empty; accepted: a folder")
        if not self.url.startswith(("http://", "https://")):
            raise SettingError(f"url is {self.url!r}; accepted: an http:// or https:// address")

    @property
    def folder(self) -> Path:
        """The folder of the scans."""
        return Path(self.dir).expanduser()

    def archive_url(self, scan: str) -> str:
        """Address of the official archive of a scan."""
        return f"{self.url.rstrip('/')}/{scan}_{RESOLUTION}.tgz"


def scan_folder(assets: Path, scan: str) -> Path:
    """Where the scan with the official folder name `scan` lies, as in the official archives."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", scan):
        raise SettingError(f"object.scan is {scan!r}; accepted: a name such as 035_power_drill")
    return assets / scan / RESOLUTION


def scan_file(assets: Path, scan: str) -> Path:
    """The mesh file of a scan; MeshError, with what to run, if it is not there."""
    path = scan_folder(assets, scan) / MESH_FILE
    if not path.is_file():
        raise MeshError(
            f"scan {path} does not exist; run `python -m runners.fetch {_choice(scan)}`, or set "
            "assets.dir (or CHSEL_ASSETS) to a folder that has it"
        )
    return path


def check_scan(path: Path, scan: str) -> str:
    """Check the mesh file of a scan against what is known of it, and describe it in one line.

    Raises MeshError if it cannot be read, is not watertight, or differs by more than 1 % from
    the expected extents.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an open mesh is an error below
        mesh = load_mesh(path)
    if not mesh.is_watertight:
        raise MeshError(f"scan {scan} is not watertight")
    extents = np.asarray(mesh.extents)
    expected = np.asarray(SCANS[scan][1] if scan in SCANS else extents)
    if np.any(np.abs(extents - expected) > EXTENT_TOLERANCE * expected):
        raise MeshError(
            f"scan {scan} measures {_millimetres(extents)}; "
            f"expected: {_millimetres(expected)}, to 1 % along each axis"
        )
    return f"{len(mesh.vertices)} vertices, {_millimetres(extents)}, watertight"


def download_scan(scan: str, assets: AssetsConfig) -> str:
    """Download a scan, check and place it; what it is, in one line.

    Of the archive only the mesh is unpacked. Raises DownloadError, and leaves nothing, if the
    archive cannot be had or its mesh is not the scan.
    """
    import pooch

    pooch.get_logger().setLevel("ERROR")
    url, folder = assets.archive_url(scan), scan_folder(assets.folder, scan)
    assets.folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=assets.folder, prefix=".download_") as temporary:
        downloader = pooch.HTTPDownloader(timeout=TIMEOUT)
        try:
            archive = pooch.retrieve(url, None, path=temporary, downloader=downloader)
        except OSError as error:
            reason = " ".join(str(error).split())
            raise DownloadError(f"{url} cannot be downloaded ({reason}); try again") from None
        mesh, wanted = Path(temporary) / MESH_FILE, Path(scan, RESOLUTION, MESH_FILE)
        try:
            with tarfile.open(archive, "r:gz") as tar:
                found = [one for one in tar if Path(one.name) == wanted and one.isfile()]
                for member in found[:1]:
                    mesh.write_bytes(cast(IO[bytes], tar.extractfile(member)).read())
            described = check_scan(mesh, scan)
        except (tarfile.TarError, zlib.error, EOFError, OSError, MeshError) as error:
            raise DownloadError(f"{url} is not the archive of the scan: {error}") from None
        folder.mkdir(parents=True)
        os.replace(mesh, folder / MESH_FILE)
    return described


def _choice(scan: str) -> str:
    if scan in SCANS:
        return f"object=ycb/{SCANS[scan][0]}"
    return f"object=ycb/drill object.scan={scan}"


def _millimetres(extents: np.ndarray) -> str:
    return " x ".join(f"{1000.0 * extent:.1f}" for extent in extents) + " mm"
