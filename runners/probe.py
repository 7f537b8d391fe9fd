"""`python -m runners.probe`: probe an object, register after every probe, record everything."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path

import yaml
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from chsel.methods import build_method
from chsel.numerics.compiler import watched
from chsel.numerics.threads import set_threads
from chsel.problem.settings import build_settings
from chsel.rehearsal import warm_up, warm_up_policy, warm_up_sensing
from runners.command.choices import calls_for_anchored
from runners.command.program import command, plain
from runners.run.display import Display, compiling_line, reading_bar
from runners.run.probe_run import Interrupt, run
from runners.run.recording import make_run_folder, write_in_run_folder
from runners.run.scene import ProbeConfig, open_scene, session_started


@command("probe")
def main(config: DictConfig) -> None:
    """Run one session."""
    values = plain(config)
    checked = build_settings(ProbeConfig, values, "probe")
    display = Display(f"{_title(checked)}, preset {checked.preset.name}, seed {checked.seed}")
    if why := _default_because():
        name = checked.method["name"]
        display.say(f"method={name} (the default for {why}; method=chsel is the paper's)")
    set_threads(checked.threads)
    method_config = dict(checked.method)
    method_name = str(method_config.pop("name", None))
    method = build_method(method_name, method_config)
    with ExitStack() as stack:
        with reading_bar() as bar, watched(lambda _: None):  # it compiles next to nothing
            scene = open_scene(checked, bar.show)
        stack.callback(scene.session.close)
        with compiling_line():
            warm_up(method)
            if scene.steering is not None:
                warm_up_policy(scene.steering.policy)
            if checked.session["kind"] == "sensors":
                warm_up_sensing()
        folder = make_run_folder(Path(checked.logs) / "probe", scene.object_name, method_name)
        write_in_run_folder(folder / "config.yaml", yaml.safe_dump(values, sort_keys=False))
        started = session_started(checked, values, method_name, scene)
        with Interrupt() as interrupt:
            interrupted = run(folder, checked, method, scene, started, interrupt, display)
    if interrupted:
        sys.exit(130)


def _title(config: ProbeConfig) -> str:
    """What is run; the object of a recorded session is known once it is read."""
    kind = str(config.session.get("kind"))
    session = f"{kind} session, {config.method.get('name')}"
    return session if kind == "recorded" else f"{config.object.name}, {session}"


def _default_because() -> str:
    """The choice that `anchored` is the default for, if it was taken as such; else ""."""
    chosen = HydraConfig.get()
    choices = chosen.runtime.choices
    if choices["method"] == "chsel" or any(w.startswith("method=") for w in chosen.overrides.task):
        return ""
    return calls_for_anchored(choices["session"], choices["policy"])


if __name__ == "__main__":
    main()
