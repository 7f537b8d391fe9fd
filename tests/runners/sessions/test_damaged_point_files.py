"""Point files that are damaged, cut or hostile end in one line, or are read as they are."""

from __future__ import annotations

import io
import zipfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from chsel.errors import ChselError, PointsError
from chsel.problem import file_checks
from runners.sessions.points import PointFile, read_points

POINTS = np.arange(9.0).reshape(3, 3) / 100
ARRAYS: dict[str, np.ndarray[Any, Any]] = {
    "surface": POINTS,
    "known": POINTS + 0.1,
    "known_sdf": np.array([0.0, 0.01, -0.02]),
    "free": POINTS + 0.3,
    "free_step": np.array([0, 1, 2]),
    "world_from_object": np.eye(4),
}


def stored(*, compressed: bool) -> bytes:
    file = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(file, **ARRAYS)
    return file.getvalue()


def same(found: PointFile) -> bool:
    """Whether everything was read as it was written."""
    free, known, surface = (found.classes[kind] for kind in ("free", "known", "surface"))
    return (
        np.array_equal(surface.points, POINTS)
        and np.array_equal(known.points, ARRAYS["known"])
        and np.array_equal(known.sdf, ARRAYS["known_sdf"])
        and np.array_equal(free.points, ARRAYS["free"])
        and np.array_equal(free.steps, ARRAYS["free_step"])
        and found.world_from_object is not None
        and np.array_equal(found.world_from_object, np.eye(4))
    )


def outcome(path: Path) -> str:
    """What reading gives: the same points, or one line of an error of the library."""
    try:
        found = read_points(path)
    except ChselError as error:
        message = str(error)
    else:
        return "same" if same(found) else "other"
    assert message.startswith(f"point file {path}: ")
    assert "\n" not in message
    assert len(message) < 500
    return "error"


@pytest.mark.parametrize("compressed", [False, True])
def test_an_npz_with_one_changed_byte_is_read_whole_or_refused(
    tmp_path: Path, compressed: bool
) -> None:
    whole, path = stored(compressed=compressed), tmp_path / "changed.npz"
    counts: Counter[str] = Counter()
    for place in range(len(whole)):
        changed = bytearray(whole)
        changed[place] ^= 0xFF if place % 2 else 0x01 << place % 8
        path.write_bytes(changed)
        counts[outcome(path)] += 1
    # A checksum covers each array; what may change unseen are times and versions in the directory.
    assert counts["other"] == 0
    assert counts["error"] > 0.5 * counts.total()
    assert counts["same"] > 0


def test_a_cut_npz_is_refused_wherever_it_is_cut(tmp_path: Path) -> None:
    whole, path = stored(compressed=True), tmp_path / "cut.npz"
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        assert outcome(path) == "error"


def zipped(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def npy(array: np.ndarray[Any, Any]) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def test_an_npz_that_unpacks_to_more_than_the_limit_is_refused_before_it_is_unpacked(
    tmp_path: Path,
) -> None:
    path = zipped(tmp_path / "bomb.npz", {"free.npy": npy(np.zeros((100_000, 3)))})
    assert path.stat().st_size < 20_000
    assert len(read_points(path).at(0).free) == 100_000
    with pytest.raises(PointsError, match=r"have 2 MiB unpacked; accepted: at most 1 MiB"):
        file_checks.read_npz(path, most_bytes=2**20, error=PointsError)


def test_the_limit_of_a_point_file_is_half_a_gibibyte(tmp_path: Path) -> None:
    path = zipped(tmp_path / "bomb.npz", {"free.npy": npy(np.zeros((10, 3)))})
    data = bytearray(path.read_bytes())
    place = data.index(b"PK\x01\x02") + 24  # the size that the directory gives for the array
    data[place : place + 4] = (600 * 2**20).to_bytes(4, "little")
    path.write_bytes(data)
    with pytest.raises(PointsError, match=r"have 600 MiB unpacked; accepted: at most 512 MiB"):
        read_points(path)


def test_an_array_that_unpacks_to_more_than_the_directory_says_is_refused(tmp_path: Path) -> None:
    path = zipped(tmp_path / "bomb.npz", {"free.npy": npy(np.zeros((1_000_000, 3)))})
    data = bytearray(path.read_bytes())
    place = data.index(b"PK\x01\x02") + 24
    data[place : place + 4] = (1000).to_bytes(4, "little")
    path.write_bytes(data)
    with pytest.raises(PointsError, match=r"not a readable \.npz file"):
        read_points(path)


def test_doubled_and_unknown_arrays_are_named(tmp_path: Path) -> None:
    path = tmp_path / "points.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("free.npy", npy(POINTS))
        with pytest.warns(UserWarning, match="Duplicate name"):
            archive.writestr("free.npy", npy(POINTS))
    with pytest.raises(PointsError, match="array free is there 2 times; accepted: once"):
        read_points(path)
    zipped(path, {"notes\n.txt": b"hello"})
    with pytest.raises(PointsError, match=r"array 'notes\\n.txt' is unknown; accepted: surface"):
        read_points(path)
    path.write_bytes(npy(POINTS))
    with pytest.raises(PointsError, match=r"not a readable \.npz file"):
        read_points(path)


@pytest.mark.parametrize("array", [np.array([["1", "2", "3"]]), np.ones((2, 3), complex)])
def test_arrays_of_other_things_than_numbers_are_refused(
    tmp_path: Path, array: np.ndarray[Any, Any]
) -> None:
    path = zipped(tmp_path / "points.npz", {"free.npy": npy(array)})
    with pytest.raises(PointsError, match=rf"free has type {array.dtype}; accepted: numbers"):
        read_points(path)


@pytest.mark.parametrize("step", ["1e300", "4294967296", "99999999999999999999", "-1"])
def test_a_step_beyond_the_last_one_is_refused(tmp_path: Path, step: str) -> None:
    path = tmp_path / "points.csv"
    path.write_text(f"x,y,z,kind,step\n0,0,0,free,{step}\n")
    with pytest.raises(PointsError, match=r"line 2: step is .*; accepted: .* 0 to 4294967295"):
        read_points(path)
    path.write_text("x,y,z,kind,step\n0,0,0,free,4294967295\n")
    assert read_points(path).steps == [4294967295]


@pytest.mark.parametrize("step", [np.uint64(2**64 - 1), np.int64(2**32), np.int64(-1)])
def test_a_step_beyond_the_last_one_of_an_array_is_refused(
    tmp_path: Path, step: np.generic
) -> None:
    path = tmp_path / "points.npz"
    np.savez(path, free=POINTS[:2], free_step=np.array([step.dtype.type(0), step]))
    with pytest.raises(PointsError, match=rf"free_step\[1\] is {step}; accepted: 0 to 4294967295"):
        read_points(path)


def test_what_an_error_quotes_of_a_file_is_short(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    for text in (
        "a" * 9000,
        "x,y,z,kind\n0,0,0," + "a" * 9000,
        f"x,y,z,kind\n{'1' * 9000}a,0,0,free",
    ):
        path.write_text(text)
        with pytest.raises(PointsError) as caught:
            read_points(path)
        assert len(str(caught.value)) < 400


def test_vertices_beside_the_faces_are_points_too(tmp_path: Path) -> None:
    path = tmp_path / "points.off"
    path.write_text("OFF\n5 1 0\n0 0 0\n1 0 0\n0 1 0\n0 0 0\n2 2 2\n3 0 1 2\n")
    found = read_points(path).at(0).known
    assert sorted(map(tuple, found.tolist())) == [
        (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (2.0, 2.0, 2.0),
    ]  # fmt: skip


def test_a_vertex_that_is_not_finite_is_named(tmp_path: Path) -> None:
    path = tmp_path / "points.off"
    path.write_text("OFF\n4 1 0\n0 0 0\n1 0 0\n0 1 0\nnan 0 0\n3 0 1 2\n")
    with pytest.raises(PointsError, match=r"surface\[3\] is not finite"):
        read_points(path)
