"""Download the scan of an object: python -m runners.fetch object=ycb/drill."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig

from chsel.errors import ChselError, MeshError, SettingError
from chsel.problem.settings import build_settings
from replay.console import Console
from runners.command.program import command, plain
from runners.objects.loader import ObjectConfig
from runners.objects.scans import MESH_FILE, AssetsConfig, check_scan, download_scan, scan_folder


@command("fetch")
def main(config: DictConfig) -> None:
    """Download the scan of the chosen object into the assets folder, unless it is there."""
    settings: dict[str, Any] = plain(config)
    assets = build_settings(AssetsConfig, settings["assets"], "assets")
    if settings["object"].get("kind") != "scan":
        raise SettingError("this object needs no download; accepted: object=ycb/NAME")
    scan = build_settings(ObjectConfig, settings["object"], "object").scan or ""
    folder = scan_folder(assets.folder, scan)
    console = Console(soft_wrap=True)
    if folder.exists():
        try:
            described = check_scan(folder / MESH_FILE, scan)
        except ChselError as error:
            raise MeshError(f"{error}; to download the scan again, move {folder} away") from error
        console.print(f"{folder} is there already: {described}")
        return
    console.print(f"downloading {assets.archive_url(scan)}")
    console.print(f"{folder}: {download_scan(scan, assets)}")
    console.print("This scan is of the YCB Object and Model Set (Calli et al.), licence CC BY 4.0.")


if __name__ == "__main__":
    main()
