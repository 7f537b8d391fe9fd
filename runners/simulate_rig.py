"""Simulate the paper's cabinet and write the robot's raw log: python -m runners.simulate_rig."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig

from chsel.errors import SettingError, require_choice
from chsel.problem.settings import build_settings, settings_mapping
from chsel.problem.streams import StreamKey
from replay.console import Console
from runners.command.program import command, plain
from runners.objects.loader import ObjectConfig, load_object
from runners.objects.scans import AssetsConfig
from runners.sensors.pose_file import write_pose
from runners.simulated_robot.cabinet import CABINET_CONFIGURATIONS
from runners.simulated_robot.settings import RobotSettings
from runners.simulated_robot.simulation import Push, simulate_log

ConfigStore.instance().store("robot", settings_mapping(RobotSettings()), package="_global_")
EPSILON = 0.001  # m: that of an object which no configuration file describes; unused here
_STOPS = {"pads": "stopped by the pads", "hand": "stopped by the hand", "end": "nothing touched"}


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
        require_choice("configuration", self.configuration, accepted=CABINET_CONFIGURATIONS)
        if not self.out or Path(self.out).suffix != ".mcap":
            raise SettingError(f"out is {self.out}; accepted: the name of a file, out=FILE.mcap")


@command("simulate_rig")
def main(config: DictConfig) -> None:
    """Write a log and the truth beside it, and say what is in it."""
    values = plain(config)
    own = {name: values.pop(name) for name in SimulateRigConfig.__dataclass_fields__}
    checked = build_settings(SimulateRigConfig, own, where="simulate_rig")
    settings = build_settings(RobotSettings, values, where="simulate_rig")
    name, seed = checked.configuration, checked.seed
    configuration = CABINET_CONFIGURATIONS[name]
    chosen = checked.object
    if "kind" not in chosen:  # our own model of the configuration's object
        chosen = {"name": configuration.object, "epsilon": EPSILON, **chosen, "configuration": name}
    model = load_object(build_settings(ObjectConfig, chosen, where="object"), checked.assets.folder)
    log = Path(checked.out or "").expanduser()
    truth = log.with_suffix(".truth.yaml")
    for path in (log, truth):
        if os.path.lexists(path) and not checked.overwrite:
            raise SettingError(f"{path} exists; accepted: another out=FILE.mcap, or overwrite=true")
    console = Console()
    console.print(f"{model.name} at scale {model.scale:g} in {name}, seed {seed}", style="bold")

    def on_push(push: Push) -> None:
        place = f"y {push.y:+.3f} z {push.z:.3f} m  pushed {push.reach:.3f} m"
        console.print(f"probe {push.step:>3}  {place}  {_STOPS[push.stopped]}")

    made = simulate_log(
        log, configuration, mesh=model.mesh, seed=seed, settings=settings, on_push=on_push
    )
    about = {"configuration": name, "object": model.name, "scale": model.scale, "seed": seed}
    write_pose(truth, made.world_from_object, about=about, overwrite=True)
    console.print(str(log), soft_wrap=True)
    console.print(str(truth), soft_wrap=True)
    console.print("  the true pose")


if __name__ == "__main__":
    main()
