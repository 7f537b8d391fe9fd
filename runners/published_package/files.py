"""Files of what the published package finds, as sets from outside, with how they came about."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from replay.files import file_digest, whole_file
from runners.evaluation.external_results import REPEAT_FOLDER
from runners.evaluation.plan import Task, Trial
from runners.evaluation.repeats import repeat_label
from runners.published_package.package_session import PackageSet


@dataclass(frozen=True)
class PackageFiles:
    """Those of one draw of a trial, in a folder of sets from outside.

    session: the trial's recording. steps: those to register. versions: of what registers.
    """

    folder: Path
    trial: Trial
    draw: int
    session: Path
    steps: tuple[int, ...]
    versions: Mapping[str, Any]

    @property
    def unit(self) -> Task:
        """As progress names it."""
        return Task(self.trial, repeat_label("package", self.draw))

    @property
    def sets(self) -> Path:
        """The hypotheses, as runners.evaluate takes them."""
        of_draw = self.folder / REPEAT_FOLDER.format(self.draw) if self.draw else self.folder
        return of_draw / self.trial.configuration / f"seed_{self.trial.seed}.npz"

    @property
    def about(self) -> Path:
        """How the sets came about; written last."""
        return self.sets.with_suffix(".about.json")

    def finished(self) -> dict[str, Any] | None:
        """What stands in `about`, if the sets are there and of the same session and versions."""
        with suppress(OSError, ValueError):
            about = json.loads(self.about.read_text())
            if self.sets.is_file() and self._made_of().items() <= about.items():
                return dict(about)
        return None

    def write(self, found: Mapping[int, PackageSet | str]) -> None:
        """The sets of the steps, or why there is none."""
        arrays: dict[str, Any] = {}
        figures: dict[str, Any] = {"failed": {}, "cpu_seconds": {}, "free_points": {}}
        for step, one in found.items():
            if isinstance(one, str):
                figures["failed"][str(step)] = one
                continue
            arrays[f"step_{step}"] = one.world_from_object
            arrays[f"cost_{step}"] = one.hypotheses.cost
            arrays[f"seconds_{step}"] = np.array(one.seconds)
            figures["cpu_seconds"][str(step)] = one.cpu_seconds
            figures["free_points"][str(step)] = one.free_points
        with whole_file(self.sets) as beside, beside.open("wb") as file:
            np.savez(file, **arrays)
        with whole_file(self.about) as beside:
            beside.write_text(json.dumps({**self._made_of(), **figures}, indent=2) + "\n")

    def _made_of(self) -> dict[str, Any]:
        return {
            "session": file_digest(self.session),
            "steps": list(self.steps),
            "draw": self.draw,
            "versions": dict(self.versions),
        }
