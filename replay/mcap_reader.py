"""Reads a recording back: the events as they were, and every registration problem."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from chsel.errors import ChselError, RecordingError
from chsel.mesh import mesh_digest
from chsel.points import KnownPoints, Workspace
from chsel.problem import ArchiveSnapshot, Hypotheses, RegistrationProblem
from chsel.streams import StreamKey
from replay.attachments import MESH, SDF_GRID, mesh_from_ply, sdf_from_bytes
from replay.events import (
    Event,
    HypothesesFound,
    Logged,
    Measured,
    Probe,
    ProblemPosed,
    SessionEnded,
    SessionStarted,
    SnapshotTaken,
    Traced,
)
from replay.foxglove_messages import FOXGLOVE, cloud_points, log_level_and_text
from replay.mcap_file import McapFile, StoredMessage
from replay.mcap_writer import STEP
from replay.schemas import FORMAT_VERSION, RECORDS, decode, message_class

_CLOUDS = {"/points/free": 3, "/points/occupied": 3, "/points/known": 4}  # columns
