"""Every kind of sources in the registry opens a source that has all members of the protocol."""

from dataclasses import fields
from itertools import islice
from typing import get_args

import numpy as np
import pytest
from omegaconf import OmegaConf

from chsel.errors import SettingError
from chsel.events import Probe, Start
from chsel.next_probe.action_lattice import ActionSettings
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.settings import settings_mapping
from replay.mcap.reader import read_recording
from runners.command import choices
from runners.objects.loader import ObjectModel, load_model
from runners.sensors.session_report import Report
from runners.sessions import KINDS, kinds_of, open_source, session_settings
from runners.sessions.source import ObjectOrigin, ProbeEvent, ProbeSource, Steerable
from tests.chsel.samples import REPOSITORY
from tests.runners.bop_dataset import write_bop
from tests.runners.sensors.sphere_log import RIG, SphereLog

RECORDING = REPOSITORY / "tests" / "replays" / "mustard_svgd.mcap"
MODEL = ObjectModel(
    "spam_can",
    load_model("spam_can", 2.5),
    scale=2.5,
    epsilon=0.001,
    configuration="can",
    of_paper=True,
)
STARTED = {"start_contacts": 3, "start_probe": 2}


def values(kind, folder):
    """Settings with which a kind opens."""
    if kind == "points":
        surface = np.random.default_rng(0).random((6, 3)) * 0.1
        np.savez(folder / "p.npz", surface=surface, surface_step=[0, 0, 1, 1, 1, 4])
        return {"path": str(folder / "p.npz")}
    if kind == "recorded":
        return {"path": str(RECORDING)}
    if kind == "sensors":
        log = SphereLog().write(folder / "log.mcap")
        return {"path": str(log), "rig": settings_mapping(RIG)}
    if kind == "bop":
        rig = OmegaConf.load(REPOSITORY / "conf" / "session" / "rig" / "depth_frame.yaml")
        image = {"scene": 2, "image": 7, "object_id": 9, "dataset": str(write_bop(folder))}
        return {**image, "rig": OmegaConf.to_container(rig)}
    return {}


@pytest.mark.parametrize("kind", KINDS)
def test_a_source_of_every_kind_has_all_members_of_the_protocol(kind, tmp_path):
    origin = KINDS[kind].object
    settings = session_settings(kind, values(kind, tmp_path) | STARTED)
    source = open_source(
        kind, settings, object_model=None if origin is ObjectOrigin.RECORDED else MODEL, seed=0
    )
    members = {*ProbeSource.__annotations__, "probes", "close"}
    assert members <= {name for name in members if hasattr(source, name)}
    assert isinstance(source.workspace, Workspace)
    sides = {ObjectOrigin.PLACED: 0.025, ObjectOrigin.REAL: 0.01}
    sides[ObjectOrigin.RECORDED] = read_recording(RECORDING).start.free_resolution
    assert source.free_resolution == sides[origin]
    assert isinstance(source.initial_points, KnownPoints)
    assert source.start == Start(contacts=3, step=2)
    assert source.push_distance == 0.0
    assert len(source.warnings) == 0
    assert (source.report is None) == (kind not in ("bop", "sensors"))
    assert (source.recorded is None) == (origin is not ObjectOrigin.RECORDED)
    if origin is ObjectOrigin.PLACED:
        events = list(islice(source.probes(), 2))
    else:
        events = list(source.probes())
        assert sum(isinstance(event, Probe) for event in events) == source.count
    assert all(isinstance(event, get_args(ProbeEvent)) for event in events)
    assert any(isinstance(event, Probe) for event in events)
    assert source.report is None or isinstance(source.report, Report)
    assert isinstance(source, Steerable) == (origin is not ObjectOrigin.REAL)
    source.close()


def test_a_recorded_source_brings_its_object_and_its_start():
    source = open_source(
        "recorded",
        session_settings("recorded", {"path": str(RECORDING)}),
        object_model=None,
        seed=0,
    )
    start = read_recording(RECORDING).start
    assert source.recorded.object == start.object == "mustard"
    assert source.recorded.sdf.digest == start.sdf.digest
    config = start.config["session"]
    assert source.start.contacts == config["start_contacts"]
    assert source.start.step == config["start_probe"]
    assert len(source.offer(ActionSettings())) == source.count


def test_only_sources_that_place_the_object_offer_faults_and_a_configuration():
    assert kinds_of(ObjectOrigin.PLACED) == ("simulated", "kinematic")
    stored = choices.ConfigStore.instance().repo["session"]
    for kind, entry in KINDS.items():
        option = OmegaConf.to_container(stored[f"{kind}.yaml"].node)
        assert option["kind"] == kind
        placed = entry.object is ObjectOrigin.PLACED
        assert ({"faults": "clean"} in option.get("defaults", [])) == placed
        assert (option.get("configuration") == "${configuration}") == placed
        presets = f"{kind}" in stored["presets"]
        assert presets == placed
        left = {field.name for field in fields(entry.settings)} - set(option) - {"rig"}
        assert placed or not left


def test_a_kind_that_does_not_exist_is_named_with_all_that_do():
    with pytest.raises(SettingError, match=r"session\.kind is 'camera'; accepted: simulated, kin"):
        session_settings("camera", {})
