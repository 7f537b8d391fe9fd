"""`python -m runners.judge FILE pose=FILE`: whether points bear out another estimator's pose."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from math import degrees
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from omegaconf import DictConfig

from chsel.errors import InputWarning, SettingError
from chsel.numerics.threads import threads
from chsel.problem.points import KnownPoints
from chsel.problem.settings import build_settings
from chsel.session.pose_judgement import CONFIRMED, CONTRADICTED, PoseJudgement
from chsel.session.session import Session
from replay.console import Console
from runners.bop import BopConfig, Estimates, measured, read_results
from runners.command.program import command, plain
from runners.evaluation.true_poses import SourceConfig
from runners.objects.loader import ObjectConfig, ObjectModel, load_object
from runners.reporting.tables import print_table, table_of
from runners.sensors.bop_scene import METRES, bop_image, read_bop_frame
from runners.sensors.pose_file import read_pose
from runners.sessions.probing_hand import panda_hand

_WRONG = 0.1  # of the diameter: MSSD above which a pose is wrong
_INLIERS = 0.9  # share of inliers below which people doubt a pose
_MM = 1000.0


@dataclass(frozen=True)
class JudgeConfig(SourceConfig):
    """conf/judge.yaml, which has all defaults and says what they are, checked."""

    pose: str | None
    dataset: str | None
    split: str
    models: str
    noise: float | None

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.pose is None) == (self.dataset is None):
            raise SettingError(
                "accepted: either pose=FILE.yaml with world_from_object, or results of the BOP "
                "challenge as the file, and dataset=FOLDER"
            )


@command("judge")
def main(config: DictConfig) -> None:
    """Judge one pose by the points of a file, or all of a BOP results file by depth images."""
    checked = build_settings(JudgeConfig, plain(config), where="judge")
    console = Console(soft_wrap=True)
    with threads(checked.threads), warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)  # the verdicts say what is suspicious
        if checked.dataset is None:
            _judge_one(checked, console)
        else:
            _judge_results(checked, console)


def _judge_one(config: JudgeConfig, console: Console) -> None:
    """Print what the points of a file say of a pose, and where to look or touch next."""
    given = read_pose(config.pose or "")
    source = config.open()
    problem = source.problems.problem(source.steps[-1])
    with Session(
        source.mesh,
        workspace=problem.workspace,
        free_resolution=problem.free_resolution,
        hand=panda_hand().shape,
        noise=config.noise,
        seed=config.seed,
    ) as session:
        _add(session, problem.points)
        found = session.register()
        judgement = session.judge(given)
        console.print(f"pose of {config.pose}: {judgement}")
        trust = found.trust
        console.print(f"poses by the points: {trust}")
        if trust is not None and trust.twins is not None:
            angle, distance = trust.twins
            console.print(f"twins: turned by {degrees(angle):.0f}°, {_MM * distance:.1f} mm apart")
        best = ", ".join(f"{value:.4f}" for value in found.world_from_object[0, :3, 3])
        console.print(f"the best pose has the object's frame at ({best}) m")
        if judgement.verdict == CONFIRMED:
            return
        probe = session.next_probe()
        if probe is None:
            console.print(f"no touch would tell more: {session.stop}")
            return
        start = ", ".join(f"{value:.3f}" for value in probe.world_from_hand[:3, 3])
        way = ", ".join(f"{value:.2f}" for value in probe.world_from_hand[:3, 2])
        expected = _MM * float(probe.decision.expected_spread[probe.action])
        console.print(
            f"what tells most: a touch from ({start}) m along ({way}); the poses are "
            f"{_MM * probe.decision.spread:.1f} mm apart, after it {expected:.1f} mm by forecast"
        )


def _add(session: Session, points: KnownPoints) -> None:
    """Let a session have all points of a problem."""
    on_surface = points.sdf == 0.0
    contacts = points.with_known(on_surface)
    others = points.with_known(~on_surface)
    given: dict[str, Any] = {
        "contacts": contacts.known,
        "free": points.free,
        "occupied": points.occupied,
        "known": others.known,
        "known_sdf": others.sdf,
    }
    if contacts.has_normals:
        given["normals"] = contacts.normals
        given["normal_noise"] = contacts.normal_noise
    session.add(**given)


class _Judged(NamedTuple):
    """A pose of a results file, and what was found of it."""

    estimates: Estimates
    number: int  # of the pose among those of its object, by score
    judgement: PoseJudgement
    error: float  # MSSD, metres
    diameter: float  # of the object, metres


def _judge_results(config: JudgeConfig, console: Console) -> None:
    """Print a row for every pose of a results file, and how many judgements are right."""
    rows = list(_judged_results(config))
    lines = [
        {
            "scene": one.estimates.scene,
            "image": one.estimates.image,
            "object": one.estimates.object_id,
            "pose": one.number,
            "verdict": one.judgement.verdict,
            "nats\nabove": one.judgement.above,
            "points within\n5 mm, %": 100.0 * one.judgement.inliers,
            "farthest\nmm": _MM * one.judgement.farthest,
            "MSSD\nmm": _MM * one.error,
        }
        for one in rows
    ]
    print_table(console, table_of("what depth says of each pose", lines, labels=5))
    print_table(console, table_of("how often that is right", _counts(rows), labels=1))


def _counts(rows: list[_Judged]) -> list[dict[str, Any]]:
    """Return how many right and wrong poses are contradicted, and have few inliers."""
    wrong = [one for one in rows if one.error > _WRONG * one.diameter]
    right = [one for one in rows if one.error <= _WRONG * one.diameter]
    lines = []
    for name, some in (
        ("right (MSSD up to a tenth of the diameter)", right),
        ("wrong", wrong),
    ):
        told = sum(one.judgement.verdict == CONTRADICTED for one in some)
        confirmed = sum(one.judgement.verdict == CONFIRMED for one in some)
        few = sum(one.judgement.inliers < _INLIERS for one in some)
        lines.append(
            {
                "poses": name,
                "count": len(some),
                "contradicted": told,
                "confirmed": confirmed,
                "undecided": len(some) - told - confirmed,
                f"under {100.0 * _INLIERS:.0f} %\nof points": few,
            }
        )
    return lines


def _judged_results(config: JudgeConfig) -> Iterator[_Judged]:
    dataset = Path(config.dataset or "").expanduser()
    bop = BopConfig(
        file=config.file, dataset=config.dataset, split=config.split, models=config.models
    )
    models: dict[int, ObjectModel] = {}
    for estimates in read_results(config.path):
        object_id = estimates.object_id
        if object_id not in models:
            chosen = ObjectConfig(
                f"object {object_id}",
                METRES,
                epsilon=METRES,
                configuration="",
                kind="file",
                path=str(dataset / config.models / f"obj_{object_id:06d}.ply"),
                symmetry=str(dataset / config.models / "models_info.json"),
            )
            models[object_id] = load_object(chosen, config.assets.folder)
        model = models[object_id]
        errors = measured(estimates, config=bop)
        session = _seen(estimates, config=config, model=model)
        for number, pose in enumerate(estimates.camera_from_object):
            yield _Judged(
                estimates,
                number,
                judgement=session.judge(pose),
                error=float(errors["surface"][number]),
                diameter=float(session.started.sdf.diameter),
            )


def _seen(estimates: Estimates, *, config: JudgeConfig, model: ObjectModel) -> Session:
    """Return a session that has seen the depth image, by the mask of the nearest true object."""
    dataset = Path(config.dataset or "").expanduser()
    scene = dataset / config.split / f"{estimates.scene:06d}"
    _, truths = bop_image(scene, estimates.image)
    object_id = estimates.object_id
    count = sum(one["obj_id"] == object_id for one in truths)
    frames = [
        read_bop_frame(scene, estimates.image, object_id=object_id, instance=instance)
        for instance in range(max(count, 1))
    ]
    place = estimates.camera_from_object[0, :3, 3]
    truth = [frame.world_from_object for frame in frames]
    away = [np.inf if one is None else ((one[:3, 3] - place) ** 2).sum() for one in truth]
    frame = frames[int(np.argmin(away))]
    session = Session(model.mesh, symmetry=model.symmetry, noise=config.noise, seed=config.seed)
    session.add(
        depth=frame.depth,
        camera=frame.camera,
        world_from_camera=frame.world_from_camera,
        mask=frame.label,
    )
    session.register()
    return session


if __name__ == "__main__":
    main()
