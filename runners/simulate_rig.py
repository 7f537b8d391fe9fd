"""Simulate the paper's cabinet and write the robot's raw log: python -m runners.simulate_rig."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig
from rich.filesize import decimal

from chsel.errors import SettingError, require_choice
from chsel.problem.settings import build_settings, settings_mapping
from chsel.problem.streams import StreamKey
from replay.console import Console
from replay.files import WritingError, whole_file
from runners.command.program import command, plain
from runners.objects.loader import ObjectConfig, load_object
from runners.objects.scans import AssetsConfig
from runners.run.display import counting_bar
from runners.sessions.configurations import Configuration
from runners.simulated_robot.cabinet import CABINET_CONFIGURATIONS
from runners.simulated_robot.settings import RobotSettings
from runners.simulated_robot.simulation import Push, SimulatedLog, probe_count, simulate_log

ConfigStore.instance().store("robot", settings_mapping(RobotSettings()), package="_global_")
EPSILON = 0.001  # m: that of an object which no configuration file describes; unused here


@dataclass(frozen=True)
class SimulateRigConfig:
    """conf/simulate_rig.yaml but for the robot. object: checked where it is used."""

    configuration: str
    object: Any
    assets: AssetsConfig
    out: str | None
    overwrite: bool
    seed: int

    def __post_init__(self) -> None:
        StreamKey(self.seed, 0)
        require_choice("configuration", self.configuration, CABINET_CONFIGURATIONS)
        if not self.out or Path(self.out).suffix != ".mcap":
            raise SettingError(f"out is {self.out}; accepted: the name of a file, out=FILE.mcap")


@command("simulate_rig")
def main(config: DictConfig) -> None:
    """Write a log and the truth beside it, and say what is in it."""
    values = plain(config)
    own = {name: values.pop(name) for name in SimulateRigConfig.__dataclass_fields__}
    checked = build_settings(SimulateRigConfig, own, "simulate_rig")
    settings = build_settings(RobotSettings, values, "simulate_rig")
    configuration = CABINET_CONFIGURATIONS[checked.configuration]
    count = probe_count(configuration, settings)
    chosen = _object(checked.object, configuration)
    log = Path(checked.out or "").expanduser()
    truth = log.with_suffix(".truth.yaml")
    for path in (log, truth):
        if os.path.lexists(path) and not checked.overwrite:
            raise SettingError(f"{path} exists; accepted: another out=FILE.mcap, or overwrite=true")
    mesh = load_object(chosen, checked.assets.folder).mesh
    console = Console()
    console.print(
        f"{chosen.name} at scale {chosen.scale:g} in {configuration.name}, probes 0 to "
        f"{count - 1}, seed {checked.seed}",
        style="bold",
    )
    try:
        with counting_bar(console) as bar:
            task = bar.add_task("probes", total=count)

            def on_push(push: Push) -> None:
                bar.advance(task)
                bar.console.print(_line(push))

            simulated = simulate_log(log, configuration, mesh, checked.seed, settings, on_push)
        with whole_file(truth) as beside:
            beside.write_text(_truth(checked, chosen, simulated))
    except WritingError as error:
        reason = error.__cause__ or error
        raise SettingError(
            f"{log} cannot be written ({getattr(reason, 'strerror', None) or reason}); accepted: "
            "an out=FILE.mcap that can be written"
        ) from error
    written = f"{decimal(log.stat().st_size)}, {simulated.messages} messages of"
    console.print(str(log), soft_wrap=True)
    console.print(f"  {written} {simulated.seconds:.1f} simulated seconds")
    console.print(str(truth), soft_wrap=True)
    console.print("  the true pose")


def _object(values: dict[str, Any], configuration: Configuration) -> ObjectConfig:
    """The chosen object; without a choice, our own model of the configuration's."""
    if "kind" not in values:
        values = {"name": configuration.object, "epsilon": EPSILON, **values}
        values["configuration"] = configuration.name
    return build_settings(ObjectConfig, values, "object")


def _line(push: Push) -> str:
    stops = {"pads": "felt by the pads", "hand": "stopped by the hand", "end": "nothing touched"}
    pads = ", ".join(f"{pad} {pixels} px" for pad, pixels in push.pressed.items() if pixels)
    return (
        f"probe {push.step:>3}  y {push.y:+.3f} z {push.z:.3f} m  pushed "
        f"{push.reach:.3f} m  {stops[push.stopped]}{f' ({pads})' if pads else ''}"
    )


def _truth(config: SimulateRigConfig, chosen: ObjectConfig, simulated: SimulatedLog) -> str:
    content = {
        "configuration": config.configuration,
        "object": chosen.name,
        "kind": chosen.kind,
        "scale": chosen.scale,
        "seed": config.seed,
        "world_from_object": simulated.world_from_object.tolist(),
    }
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None)


if __name__ == "__main__":
    main()
