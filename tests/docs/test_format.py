"""A program that knows docs/format*.md, mcap and numpy reads recordings as ours does."""

import hashlib
import re
import struct
from collections import defaultdict
from itertools import islice

import numpy as np
import pytest
from mcap.reader import make_reader

from replay.mcap.reader import read_recording
from replay.mcap.schemas import MESSAGES
from tests.chsel.samples import REPOSITORY

NAMES = ("format", "format_probes", "format_results")
PAGES = "\n".join((REPOSITORY / "docs" / f"{name}.md").read_text() for name in NAMES)
SECTIONS = re.findall(r"^### `chsel\.(\w+)`\n(.*?)(?=^#|\Z)", PAGES, re.MULTILINE | re.DOTALL)
ROW = re.compile(r"^\| (\d+) \| `(\w+)` \| `([^`]+)` \|", re.MULTILINE)
FIELDS = {name: {int(n): tuple(row) for n, *row in ROW.findall(text)} for name, text in SECTIONS}
CLOUD = {"PointCloud": {6: ("data", "bytes")}}


def varints(data):
    """The integers that bytes hold, seven bits a byte, the lowest first."""
    value = shift = 0
    for byte in data:
        value = value | (byte & 127) << shift
        shift = shift + 7
        if byte < 128:
            yield value
            value = shift = 0


def decode(name, data):
    """The fields of a message that are there."""
    found = {}
    data = iter(data)
    while tag := next(varints(data), None):
        size = {1: 8, 5: 4}.get(tag & 7) or next(varints(data))
        value = bytes(islice(data, size)) if tag & 7 else size
        field, kind = (FIELDS | CLOUD)[name].get(tag >> 3, ("", ""))
        if "[" in kind:
            array = {"data": b""} | decode("Array", value)
            value = np.frombuffer(array["data"], array["dtype"]).reshape(array["shape"])
        elif kind.rstrip("?*") in FIELDS:
            value = decode(kind.rstrip("?*"), value)
        elif kind in ("double", "string"):
            value = struct.unpack("<d", value)[0] if kind == "double" else value.decode()
        elif kind == "sint32":
            value = value >> 1 ^ -(value & 1)
        elif kind in ("uint32*", "uint64*"):
            value = list(varints(value))
        found[field] = [*found.get(field, []), value] if kind in ("Number*", "Text*") else value
    return found


def digest(*arrays):
    parts = (f"{one.dtype.str}{one.shape};".encode() + one.tobytes() for one in arrays)
    return hashlib.blake2b(b"".join(parts), digest_size=16).hexdigest()


def test_the_tables_are_those_of_the_code():
    for name, fields in MESSAGES.items():
        kinds = (kind if isinstance(kind, str) else kind[0] for kind in fields.values())
        assert FIELDS[name] == dict(enumerate(zip(fields, kinds, strict=True), 1))


@pytest.mark.parametrize("name", ["mustard_anchored", "box_steered"])
def test_what_the_pages_say_is_enough_to_read(name):
    path = REPOSITORY / "tests" / "replays" / f"{name}.mcap"
    topics = defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for schema, channel, stamped in reader.iter_messages(log_time_order=False):
            kind = schema.name.split(".")[1]
            if kind in FIELDS or channel.topic.startswith("/points/"):
                topics[channel.topic].append(decode(kind, stamped.data))
        grid = next(a.data for a in reader.iter_attachments() if a.name == "sdf_grid")
    ours = read_recording(path)
    equal = np.testing.assert_array_equal
    grid = {
        name: np.array(value, "<f8", ndmin=1) for name, value in decode("SdfGrid", grid).items()
    }
    equal(grid["values"], ours.start.sdf.values)
    assert digest(*grid.values()) == topics["/session"][0]["sdf_digest"]
    for mine, probe in zip(topics["/probe"], ours.probes, strict=True):
        assert (mine.get("step", 0), mine["outcome"]) == (probe.step, probe.outcome)
        equal(mine["contacts"], probe.contacts)
        equal(mine["gripper_path"], probe.gripper_path)
    known = np.frombuffer(b"".join(m["data"] for m in topics["/points/known"])).reshape(-1, 4)
    free = np.frombuffer(b"".join(m["data"] for m in topics["/points/free"])).reshape(-1, 3)
    points = ours.problem(ours.steps[-1]).points
    equal(known, np.column_stack([points.known, points.sdf]))
    equal(free, points.free)
    elites = None
    pairs = zip(topics["/problem"], topics["/hypotheses"], topics["/measured"], strict=True)
    for step, (posed, found, measured) in zip(ours.steps, pairs, strict=True):
        sets = posed["initial_set"], posed.get("low_cost_set", elites)
        text = posed["sdf_digest"] + posed["points_digest"] + digest(*sets)
        numbers = np.array([*posed["workspace"].flat, posed["free_resolution"]])
        key = np.array([posed.get("key_seed", 0), posed.get("key_step", 0)], "<u8")
        assert digest(np.frombuffer(text.encode(), "u1"), numbers, key) == posed["digest"]
        equal(found["object_from_world"][0], ours.hypotheses(step).object_from_world[0])
        names = ("object_from_world", "cost", "duplicate", "cell", "elites")
        assert digest(*(found[one] for one in names)) == ours.hypotheses(step).digest
        values = {one["name"]: one.get("value", 0.0) for one in measured["values"]}
        assert values["distinct_hypotheses"] == ours.hypotheses(step).distinct
        elites = found["elites"]
    for made in topics["/decision"]:
        theirs = ours.decision(made.get("step", 0)).decision
        assert made.get("chosen", 0) == theirs.chosen
        equal(made["score"], theirs.score)
