"""Scans of the YCB Object and Model Set: where they lie, and their download."""

from __future__ import annotations

import os
import re
import tarfile
import tempfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO, cast

import numpy as np

from chsel.errors import ChselError, MeshError, SettingError
from chsel.problem.mesh import load_mesh

SCANS = {
    "035_power_drill": "drill",
    "006_mustard_bottle": "mustard",
    "048_hammer": "hammer",
    "003_cracker_box": "cracker_box",
    "010_potted_meat_can": "spam_can",
    "050_medium_clamp": "clamp",
}
"""Names of the choices by official folder."""
URL = "http://ycb-benchmarks.s3-website-us-east-1.amazonaws.com/data/google"
TIMEOUT = 30.0  # seconds without a byte of a download
RESOLUTION = "google_16k"
MESH_FILE = "nontextured.ply"


class DownloadError(ChselError):
    """A scan could not be downloaded, or is not what was asked for."""


@dataclass(frozen=True)
class AssetsConfig:
    """The folder of scans, and the address of their downloads."""

    dir: str  # the folder; ~ is the home folder
    url: str  # address of the folder of the official archives

    @property
    def folder(self) -> Path:
        """The folder of the scans."""
        return Path(self.dir).expanduser()

    def archive_url(self, scan: str) -> str:
        """Return the address of the official archive of a scan."""
        return f"{self.url.rstrip('/')}/{scan}_{RESOLUTION}.tgz"


def scan_folder(assets: Path, scan: str) -> Path:
    """Return the folder of the scan with the official folder name `scan`, as in the archives."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", scan):
        raise SettingError(f"object.scan is {scan!r}; accepted: a name such as 035_power_drill")
    return assets / scan / RESOLUTION


def scan_file(assets: Path, scan: str) -> Path:
    """Return the mesh file of a scan. Raise MeshError, with what to run, if it is not there."""
    path = scan_folder(assets, scan) / MESH_FILE
    if not path.is_file():
        choice = f"ycb/{SCANS[scan]}" if scan in SCANS else f"ycb/drill object.scan={scan}"
        raise MeshError(
            f"scan {path} does not exist; run `python -m runners.fetch object={choice}`, or set "
            "assets.dir (or CHSEL_ASSETS) to a folder that has it"
        )
    return path


def download_scan(scan: str, assets: AssetsConfig) -> str:
    """Download a scan and place it; what it is, in one line.

    Of the archive only the mesh is unpacked. Raise DownloadError, and leave nothing, if the
    archive cannot be had or has no closed mesh of the scan.
    """
    import pooch

    pooch.get_logger().setLevel("ERROR")
    url = assets.archive_url(scan)
    folder = scan_folder(assets.folder, scan)
    assets.folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=assets.folder, prefix=".download_") as temporary:
        downloader = pooch.HTTPDownloader(timeout=TIMEOUT)
        try:
            archive = pooch.retrieve(url, None, path=temporary, downloader=downloader)
        except OSError as error:
            reason = " ".join(str(error).split())
            raise DownloadError(f"{url} cannot be downloaded ({reason}); try again") from None
        path = Path(temporary) / MESH_FILE
        wanted = Path(scan, RESOLUTION, MESH_FILE)
        try:
            with tarfile.open(archive, "r:gz") as tar:
                found = [one for one in tar if Path(one.name) == wanted and one.isfile()]
                for member in found[:1]:
                    path.write_bytes(cast(IO[bytes], tar.extractfile(member)).read())
            mesh = load_mesh(path)
            if not mesh.is_watertight:
                raise MeshError("its mesh is not watertight")
        except (tarfile.TarError, zlib.error, EOFError, OSError, MeshError) as error:
            raise DownloadError(f"{url} is not the archive of the scan: {error}") from None
        folder.mkdir(parents=True)
        os.replace(path, folder / MESH_FILE)
    extents = " x ".join(f"{1000.0 * extent:.1f}" for extent in np.asarray(mesh.extents))
    return f"{len(mesh.vertices)} vertices, {extents} mm"
