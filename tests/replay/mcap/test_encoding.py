"""Messages of the table: exact both ways, strict about types, shapes and bytes."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from chsel.errors import RecordingError
from replay.mcap.encoding import decode, encode, field_kinds
from replay.mcap.foxglove_messages import cloud_points, point_cloud
from replay.mcap.schemas import MESSAGES
from tests.replay.conftest import same_bits

WHOLE = {"uint32": (0, 2**32 - 1), "uint64": (0, 2**64 - 1), "sint32": (-(2**31), 2**31 - 1)}
SCALARS = {
    "string": st.text(max_size=8),
    "double": st.floats(),
    "bool": st.booleans(),
    "bytes": st.binary(max_size=8),
    **{name: st.integers(*ends) for name, ends in WHOLE.items()},
}


@st.composite
def values_of(draw, name):
    """Any values that a message of the table can have."""
    lengths: dict[str, int] = {}
    return {
        field: draw(_value(kind, lengths, draw=draw)) for field, kind in field_kinds(name).items()
    }


def _value(kind, lengths, *, draw):
    if kind.dtype is not None:
        shape = tuple(
            int(side)
            if side.isdigit()
            else lengths.setdefault(side, draw(st.integers(0, 3), label=side))
            for side in kind.shape
        )
        dtype = draw(st.sampled_from([kind.dtype, kind.dtype.newbyteorder(">")]))
        found: st.SearchStrategy[Any] = arrays.arrays(dtype, shape)
    elif kind.is_mapping:
        value = SCALARS["double" if kind.type == "Number" else "string"]
        found = st.dictionaries(st.text(max_size=3), value, max_size=3)
    elif kind.is_message:
        found = values_of(kind.type)
    else:
        found = SCALARS[kind.type]
        found = st.lists(found, max_size=3).map(tuple) if kind.repeated else found
    return st.one_of(st.none(), found) if kind.optional else found


def native(value):
    """Arrays in the machine's byte order and in C order, as a reader gets them."""
    if isinstance(value, dict):
        return {name: native(item) for name, item in value.items()}
    if isinstance(value, np.ndarray):
        return np.ascontiguousarray(value, value.dtype.newbyteorder("="))
    return value


@pytest.mark.parametrize("name", MESSAGES)
@given(data=st.data())
def test_values_come_back_exactly_whatever_the_order_of_their_bytes(name, data):
    values = data.draw(values_of(name))
    written = encode(name, values)
    assert same_bits(decode(name, written), native(values))
    assert encode(name, decode(name, written)) == written


@given(points=arrays.arrays(np.float64, st.tuples(st.integers(0, 4), st.sampled_from([3, 4]))))
def test_clouds_keep_every_bit_and_their_columns(points):
    columns = points.shape[1]
    assert cloud_points(point_cloud(points, 5), columns).tobytes() == points.tobytes()
    with pytest.raises(RecordingError, match=r"a point cloud has other fields than x, y, z"):
        cloud_points(point_cloud(points, 5), 7 - columns)
