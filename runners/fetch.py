"""Download the scan of an object: python -m runners.fetch object=ycb/drill."""

from __future__ import annotations

from omegaconf import DictConfig

from chsel.errors import SettingError
from chsel.problem.settings import build_settings
from replay.console import Console
from runners.command.program import command, plain
from runners.objects.loader import ObjectConfig
from runners.objects.scans import AssetsConfig, download_scan, scan_folder


@command("fetch")
def main(config: DictConfig) -> None:
    """Download the scan of the chosen object into the assets folder, unless it is there."""
    settings = plain(config)
    assets = build_settings(AssetsConfig, settings["assets"], where="assets")
    chosen = build_settings(ObjectConfig, settings["object"], where="object")
    if chosen.kind != "scan" or chosen.scan is None:
        raise SettingError("this object needs no download; accepted: object=ycb/NAME")
    scan = chosen.scan
    folder = scan_folder(assets.folder, scan)
    console = Console(soft_wrap=True)
    if folder.exists():
        console.print(f"{folder} is there already; to download the scan again, move it away")
        return
    console.print(f"downloading {assets.archive_url(scan)}")
    console.print(f"{folder}: {download_scan(scan, assets)}")
    console.print("This scan is of the YCB Object and Model Set (Calli et al.), licence CC BY 4.0.")


if __name__ == "__main__":
    main()
