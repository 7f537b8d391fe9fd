"""Episodes of LeRobot datasets (v3), whose rows are the messages of a log.

The files are those of https://github.com/huggingface/lerobot: `meta/info.json` and parquet. They
say neither frames nor units, so the columns of a rig do.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from chsel.errors import ChselError, SessionError
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import (
    check_rigid,
    compose,
    roll_pitch_yaw,
    rotation_matrices,
    rotation_vector,
)
from replay.files import file_digest
from runners.sensors.log.forward_kinematics import Arm
from runners.sensors.log.messages import (
    CloudMessage,
    Content,
    Received,
    TransformMessage,
    WrenchMessage,
)
from runners.sensors.rig import ColumnRig

INFO = Path("meta") / "info.json"
_VERSION = "v3."
_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "rad": 1.0, "deg": math.pi / 180.0}
_SCHEMAS = {"pose": "TransformStamped", "joints": "TransformStamped"}
_FIRST = 1_000_000_000  # nanoseconds: log time of an episode's begin, as 0 is none
_OFF_UNIT = 0.01  # of a quaternion's length
_ACCEPTED = "accepted: a folder of a LeRobot dataset v3, with meta/info.json and its parquet files"

Read = Callable[[FloatArray], Iterator[Content]]
"""From the numbers of a row's column to what they say."""


class LeRobotEpisode:
    """An episode, read as `RawLog` is; its topics are the columns of a rig."""

    topics: dict[str, str]
    """Kinds by the names of columns."""

    faults: Counter[str]
    """How often rows were skipped, by "column: reason"."""

    warnings: tuple[str, ...] = ()
    """Lines for the user; none."""

    def __init__(self, path: Path, columns: tuple[ColumnRig, ...], *, episode: int | None) -> None:
        """Read the columns of an episode. Raise SessionError, which names what is missing."""
        self.path = path
        self.faults = Counter()
        try:
            info = _info(path)
            self._file, self._episode = _data_file(path, info, episode=episode)
            self._readers: dict[str, list[Read]] = {}  # a column may say several things
            for column in columns:
                reader = _reader(column, info, folder=path)
                self._readers.setdefault(column.column, []).append(reader)
            self._rows = _rows(self._file, self._episode, columns=list(self._readers))
        except ModuleNotFoundError as error:
            raise SessionError(
                f"dataset {path} needs the package {error.name}; install it where the project is: "
                "pip install -e '.[sensors]'"
            ) from None
        except (ChselError, OSError, KeyError, TypeError, ValueError) as error:
            reason = f"no {error}" if isinstance(error, KeyError) else str(error)
            accepted = "" if "accepted:" in reason else f"; {_ACCEPTED}"
            raise SessionError(f"dataset {path}: {' '.join(reason.split())}{accepted}") from None
        self.topics = {}
        for column in sorted(columns, key=lambda column: column.kind in _SCHEMAS):
            self.topics[column.column] = f"column/{_SCHEMAS.get(column.kind, column.kind)}"
        times = self._times()
        self.begin = int(times[0])
        self.end = int(times[-1])

    def messages(self, topics: Collection[str]) -> Iterator[Received]:
        """Yield what columns say, row by row."""
        faults: Counter[str] = Counter()
        for number, time in enumerate(self._times().tolist()):
            for name in [name for name in self._readers if name in topics]:
                values = np.ravel(np.asarray(self._rows[name][number], dtype=np.float64))
                for read in self._readers[name]:
                    try:
                        for content in read(values):
                            yield Received(name, time, stamp=None, content=content)
                    except ChselError as error:
                        faults[f"{name}: {error}"] += 1
        self.faults |= faults

    def listing(self) -> str:
        """Return all columns of the rig with their kinds, for messages to the user."""
        return ", ".join(f"{name} ({kind})" for name, kind in sorted(self.topics.items()))

    def digest(self) -> str:
        """Return BLAKE2b (128 bit, hexadecimal) of the digest of the data file and the episode."""
        text = f"{file_digest(self._file)}\n{self._episode}\n"
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def _times(self) -> np.ndarray:
        """Return the log times (N,) of the rows, nanoseconds."""
        seconds = np.asarray(self._rows["timestamp"], dtype=np.float64).reshape(-1)
        return _FIRST + np.rint(1e9 * seconds).astype(np.int64)


def _info(path: Path) -> Mapping[str, Any]:
    """Return meta/info.json of a dataset. Raise SessionError for another version."""
    info = json.loads((path / INFO).read_bytes())
    version = str(info.get("codebase_version"))
    if not version.startswith(_VERSION):
        raise SessionError(
            f"its codebase_version is {version}; datasets before v3 are converted by LeRobot"
        )
    features: Mapping[str, Any] = info
    return features


def _data_file(path: Path, info: Mapping[str, Any], *, episode: int | None) -> tuple[Path, int]:
    """Return the file of an episode's rows, and its index."""
    import pyarrow.dataset as parquet

    wanted = ["episode_index", "data/chunk_index", "data/file_index"]
    table = parquet.dataset(path / "meta" / "episodes", format="parquet").to_table(columns=wanted)
    episodes = {int(row["episode_index"]): row for row in table.to_pylist()}
    if episode is None and len(episodes) == 1:
        (episode,) = episodes
    if episode not in episodes:
        raise SessionError(
            f"episode is {episode}; accepted: one of its {len(episodes)}, {min(episodes)} to "
            f"{max(episodes)}, as session.rig.episode"
        )
    row = episodes[episode]
    name = str(info["data_path"]).format(
        chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
    )
    return path / name, episode


def _rows(file: Path, episode: int, *, columns: list[str]) -> dict[str, list[Any]]:
    """Return the values of columns of an episode's rows, in the order of time."""
    import pyarrow.parquet as parquet

    names = ["timestamp", *columns]
    table = parquet.read_table(file, columns=names, filters=[("episode_index", "=", episode)])
    if table.num_rows == 0:
        raise SessionError(f"{file.name} has no row of episode {episode}")
    found: dict[str, list[Any]] = table.sort_by("timestamp").to_pydict()
    return found


def _reader(column: ColumnRig, info: Mapping[str, Any], *, folder: Path) -> Read:
    """Return what reads a column. Raise SessionError for one that the dataset has not."""
    features = info["features"]
    if column.column not in features:
        numbers = [name for name, each in features.items() if each["dtype"] != "video"]
        raise SessionError(f"it has no column {column.column}; it has {', '.join(numbers)}")
    size = math.prod(features[column.column]["shape"])
    if max(column.select, default=-1) >= size:
        raise SessionError(f"{column.column} has {size} numbers, and select {column.select}")
    count = len(column.select) or size
    if count not in column.counts:
        raise SessionError(
            f"{column.column} gives {count} numbers; accepted: "
            f"{' or '.join(map(str, column.counts))} of kind {column.kind}, chosen by select"
        )
    if column.kind == "joints":
        arm = None
        if column.urdf is not None:
            arm = Arm(folder / Path(column.urdf).expanduser(), column.root, link=column.frame)
            arm.require(column.joints)
        return partial(_joints, column, arm=arm)
    return partial(_READS[column.kind], column)


def _chosen(column: ColumnRig, values: FloatArray) -> FloatArray:
    """Return the numbers of a column that are used. Raise SessionError unless they are finite."""
    values = values[list(column.select)] if column.select else values
    if not np.isfinite(values).all():
        raise SessionError("a row is not finite; it is left out")
    return values


def _pose(column: ColumnRig, values: FloatArray) -> Iterator[Content]:
    """Yield the pose of a row: a place, and a rotation as the rig says."""
    values = _chosen(column, values)
    turn = values[3:]
    if column.rotation in ("quaternion_xyzw", "quaternion_wxyz"):
        turn = np.roll(turn, -1) if column.rotation == "quaternion_wxyz" else turn
        length = float(np.sqrt((turn**2).sum()))
        if abs(length - 1.0) > _OFF_UNIT:
            raise SessionError(f"a quaternion has the length {length:.3g}; it is left out")
        rotation = rotation_matrices(turn[None] / length)[0]
    elif column.rotation == "matrix":
        rotation = turn.reshape(3, 3)
        check_rigid("a rotation", compose(rotation, np.zeros(3))[None])
    else:
        turn = turn * _UNITS[column.angle or ""]
        rotation = (
            rotation_vector(turn) if column.rotation == "rotation_vector" else roll_pitch_yaw(turn)
        )
    pose = compose(rotation, values[:3] * _UNITS[column.unit or ""])
    yield TransformMessage(column.parent or "", column.frame or "", parent_from_child=pose)


def _joints(column: ColumnRig, values: FloatArray, *, arm: Arm | None) -> Iterator[Content]:
    """Yield the positions of joints, and the pose of a link that follows from a URDF."""
    values = _chosen(column, values) * _UNITS[column.unit or ""]
    positions = dict(zip(column.joints, values.tolist(), strict=True))
    yield positions
    if arm is not None:
        pose = arm.pose(positions)
        yield TransformMessage(column.parent or "", column.frame or "", parent_from_child=pose)


def _wrench(column: ColumnRig, values: FloatArray) -> Iterator[Content]:
    """Yield a force and a torque; without a torque it is 0."""
    values = np.concatenate([_chosen(column, values), np.zeros(3)])[:6]
    yield WrenchMessage(column.frame or "", values[:3], torque=values[3:])


def _taxels(column: ColumnRig, values: FloatArray) -> Iterator[Content]:
    """Yield the places of taxels whose value is above the threshold."""
    values = _chosen(column, values)
    assert column.threshold is not None
    touched = values > column.threshold
    normals = np.array(column.normals)[touched] if column.normals else None
    yield CloudMessage(column.frame or "", np.array(column.points)[touched], normals=normals)


def _marker(column: ColumnRig, values: FloatArray) -> Iterator[Content]:
    """Yield the index of the probe of a row, below 0 outside of probes."""
    yield str(int(_chosen(column, values)[0]))


_READS = {"pose": _pose, "wrench": _wrench, "taxels": _taxels, "marker": _marker}
