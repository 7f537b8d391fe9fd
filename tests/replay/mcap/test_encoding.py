"""Messages from the table of schemas: exact both ways, strict about types and shapes."""

from __future__ import annotations

import numpy as np
import pytest

from chsel.errors import RecordingError
from replay.mcap.encoding import decode, encode, field_kinds, message_class
from replay.mcap.schemas import MESSAGES

ARCHIVE = {
    "step": -1,
    "iteration": 2**32 - 1,
    "refinement": 0,
    "measure_names": ("x", "é"),
    "shape": (40, 30),
    "lower": np.array([-0.0, np.nan]),
    "upper": np.array([np.inf, 5e-324]),
    "cells": np.array([2**62]),
    "solutions": np.ones((1, 9)),
    "objectives": np.ones(1),
    "measures": np.ones((1, 2)),
    "digest": "ab",
}


def changed(**fields: tuple[str, list[int], bytes]) -> bytes:
    """The archive with some of its Array messages replaced by (dtype, shape, data)."""
    message = message_class("ArchiveSnapshot").FromString(encode("ArchiveSnapshot", ARCHIVE))
    for name, (dtype, shape, data) in fields.items():
        array = getattr(message, name)
        array.Clear()
        array.dtype, array.data = dtype, data
        array.shape.extend(shape)
    return message.SerializeToString()


def test_values_come_back_exactly():
    values = decode("ArchiveSnapshot", encode("ArchiveSnapshot", ARCHIVE))
    for name, value in ARCHIVE.items():
        if isinstance(value, np.ndarray):
            assert values[name].dtype == value.dtype
            assert values[name].tobytes() == value.tobytes()
            assert values[name].shape == value.shape
        else:
            assert values[name] == value


def test_arrays_are_little_endian_and_row_major_whatever_they_were():
    array = np.asfortranarray(np.arange(18.0).reshape(2, 9)).astype(">f8")
    values = ARCHIVE | {
        "solutions": array,
        "cells": np.arange(2),
        "objectives": np.ones(2),
        "measures": np.ones((4, 2))[::2],
    }
    data = encode("ArchiveSnapshot", values)
    stored = message_class("ArchiveSnapshot").FromString(data).solutions
    assert stored.dtype == "<f8"
    assert stored.data == np.arange(18, dtype="<f8").tobytes()
    assert decode("ArchiveSnapshot", data)["solutions"].tolist() == array.tolist()


def test_absent_fields_are_none_and_required_ones_are_missed():
    hypotheses = {
        "step": 0,
        "object_from_world": np.zeros((0, 4, 4)),
        "cost": np.zeros(0),
        "duplicate": np.zeros(0, dtype=bool),
        "cell": np.zeros(0, dtype=np.int64),
        "elites": np.zeros((0, 4, 4)),
        "archive": None,
        "archive_is_last_snapshot": False,
        "digest": "",
    }
    data = encode("Hypotheses", hypotheses)
    assert decode("Hypotheses", data)["archive"] is None
    message = message_class("Hypotheses").FromString(data)
    message.ClearField("elites")
    with pytest.raises(RecordingError, match=r"Hypotheses\.elites is missing"):
        decode("Hypotheses", message.SerializeToString())


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"cells": ("|O", [1], b"\0" * 8)}, r"cells is of type '\|O'; accepted: '<i8'"),
        ({"cells": ("<f8", [1], b"\0" * 8)}, "cells is of type '<f8'; accepted: '<i8'"),
        ({"cells": ("<i8", [1], b"\0" * 7)}, r"cells has 7 bytes, which do not fill .* \(1,\)"),
        (
            {"objectives": ("<f8", [2], b"\0" * 16)},
            r"objectives: .*\(2,\); accepted: float64 \(1\)",
        ),
        ({"measures": ("<f8", [1, 3], b"\0" * 24)}, r"measures: .*\(1, 3\); accepted: .*\(1, 2\)"),
        ({"solutions": ("<f8", [1], b"\0" * 8)}, r"solutions: .*\(1,\); accepted: .*\(1, d\)"),
        ({"solutions": ("<f8", [1, 2**63], b"")}, "solutions has 0 bytes"),
        (
            {
                "cells": ("<i8", [0], b""),
                "solutions": ("<f8", [0, 2**63], b""),
                "objectives": ("<f8", [0], b""),
                "measures": ("<f8", [0, 2], b""),
            },
            "solutions has 0 bytes",
        ),
    ],
)
def test_arrays_that_are_not_as_the_table_says_are_refused(fields, message):
    with pytest.raises(RecordingError, match=message):
        decode("ArchiveSnapshot", changed(**fields))


@pytest.mark.parametrize(
    "values", [{"iteration": -1}, {"iteration": 1.5}, {"digest": 3}, {"digest": "\ud800"}]
)
def test_values_that_do_not_fit_their_field_are_refused(values):
    name = next(iter(values))
    with pytest.raises(RecordingError, match=rf"ArchiveSnapshot\.{name} cannot be recorded: "):
        encode("ArchiveSnapshot", ARCHIVE | values)


def test_truth_values_other_than_0_and_1_are_refused():
    message = message_class("Hypotheses")()
    for name in ("object_from_world", "cost", "duplicate"):
        array = getattr(message, name)
        kind = field_kinds("Hypotheses")[name]
        array.dtype = kind.dtype.str
        shape = [1, 4, 4][: len(kind.shape)]
        array.shape.extend(shape)
        array.data = b"\2" * (int(np.prod(shape)) * kind.dtype.itemsize)
    with pytest.raises(RecordingError, match=r"duplicate holds bytes other than 0 and 1"):
        decode("Hypotheses", message.SerializeToString())


def test_bytes_that_are_no_message_are_refused():
    with pytest.raises(RecordingError, match=r"a message is not a valid chsel\.Probe"):
        decode("Probe", b"\xff\xff\xff")


@pytest.mark.parametrize("name", MESSAGES)
def test_field_numbers_follow_the_table(name):
    fields = message_class(name).DESCRIPTOR.fields
    assert [field.number for field in fields] == list(range(1, len(MESSAGES[name]) + 1))
    assert [field.name for field in fields] == list(MESSAGES[name])
