"""Download the scan of an object: python -m runners.fetch object=ycb/drill."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.progress import (
    BarColumn,
    DownloadColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from chsel.errors import ChselError, MeshError, SettingError
from chsel.problem.settings import build_settings
from replay.console import Console, TextColumn
from replay.console import Progress as ProgressBar
from runners.command.program import command, plain
from runners.objects.loader import ObjectConfig
from runners.objects.scan_archive import DownloadError, Progress, download, unpack
from runners.objects.scans import MESH_FILE, AssetsConfig, check_scan, scan_folder


@command("fetch")
def main(config: DictConfig) -> None:
    """Download the scan of the chosen object into the assets folder, unless it is there."""
    settings: dict[str, Any] = plain(config)
    assets = build_settings(AssetsConfig, settings["assets"], "assets")
    scan = _chosen_scan(settings["object"])
    folder = scan_folder(assets.folder, scan)
    console = Console(soft_wrap=True)
    if folder.exists():
        console.print(f"{folder} is there already: {_check_present(folder, scan)}")
        return
    with progress_bar(scan) as progress:
        found = fetch_scan(scan, assets, progress)
    console.print(f"{folder}: {found}")
    console.print("This scan is of the YCB Object and Model Set (Calli et al.), licence CC BY 4.0.")


def fetch_scan(scan: str, assets: AssetsConfig, progress: Progress) -> str:
    """Download, unpack, check and place one scan; what was found, in one line.

    Nothing appears in the scan's own folder before all checks have passed. Raises DownloadError
    if the archive cannot be had or is harmful, MeshError if its mesh is not the scan.
    """
    folder = scan_folder(assets.folder, scan)
    url = assets.archive_url(scan)
    archive = assets.folder / url.rpartition("/")[2]
    if not archive.exists():
        download(url, archive, progress=progress)
    with tempfile.TemporaryDirectory(dir=assets.folder, prefix=".unpacking_") as temporary:
        unpacked = scan_folder(Path(temporary), scan)
        try:
            unpack(archive, Path(temporary))
            found = check_scan(unpacked / MESH_FILE, scan)
        except (DownloadError, MeshError) as error:
            archive.unlink()
            raise DownloadError(f"{url} is not the archive of the scan: {error}") from error
        folder.parent.mkdir(exist_ok=True)
        os.replace(unpacked, folder)
    archive.unlink()
    return found


@contextmanager
def progress_bar(title: str) -> Iterator[Progress]:
    """A bar on the terminal that follows the calls of what is yielded."""
    text, bar_column = TextColumn("{task.description}"), BarColumn()
    columns = (text, bar_column, DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
    with ProgressBar(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _chosen_scan(mapping: dict[str, Any]) -> str:
    if mapping.get("kind") != "scan":
        raise SettingError("this object needs no download; accepted: object=ycb/NAME")
    return build_settings(ObjectConfig, mapping, "object").scan or ""


def _check_present(folder: Path, scan: str) -> str:
    try:
        return check_scan(folder / MESH_FILE, scan)
    except ChselError as error:
        raise MeshError(f"{error}; to download the scan again, move {folder} away") from error


if __name__ == "__main__":
    main()
