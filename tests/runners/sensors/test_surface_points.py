"""Normals that a rig asks for: each point keeps those of its sensor, and their noise."""

from dataclasses import replace
from math import radians

import numpy as np
import pytest

from chsel.errors import SettingError
from chsel.problem.settings import build_settings
from runners.sensors.rig import Annotations, CloudRig, ExtraContacts, Rig
from tests.runners.sensors.small_logs import read
from tests.runners.sensors.sphere_log import CENTRE, LIDAR, RADIUS, RIG, SphereLog

TOWARDS_LIDAR = (LIDAR - CENTRE) / np.sqrt(((LIDAR - CENTRE) ** 2).sum())
ADDED = ((0.9, 0.0, 0.49), (0.9, 0.04, 0.45))
PAD, SURFACE, SKIN = 10.0, 20, 35.5  # degrees
RIG_OF_THREE = replace(
    RIG,
    bubbles=(replace(RIG.bubbles[0], normals=PAD),),
    clouds=(CloudRig("/lidar", "surface", normals=SURFACE), CloudRig("/skin", "contacts")),
    annotations=Annotations(contacts=(ExtraContacts(0, ADDED),)),
)


def seen_on_sphere():
    """Points (N, 3) of the sphere, world, that the lidar sees."""
    ways = np.random.default_rng(7).normal(size=(6000, 3))
    ways /= np.sqrt((ways**2).sum(axis=1, keepdims=True))
    return CENTRE + RADIUS * ways[ways @ TOWARDS_LIDAR > 0.5]


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    cloud = tuple(map(tuple, (seen_on_sphere() - LIDAR).tolist()))
    return SphereLog(cloud=cloud).write(tmp_path_factory.mktemp("log") / "log.mcap")


def off(points, normals):
    """Angles (N,) of normals at points of the sphere, degrees."""
    cosine = (normals * (points - CENTRE)).sum(axis=1) / np.sqrt(
        ((points - CENTRE) ** 2).sum(axis=1)
    )
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def test_each_contact_has_the_normal_and_the_noise_of_its_sensor(log):
    with_skin = replace(
        RIG_OF_THREE, clouds=(RIG_OF_THREE.clouds[0], CloudRig("/skin", "contacts", normals=SKIN))
    )
    for rig, skin in ((RIG_OF_THREE, 0.0), (with_skin, radians(SKIN))):
        session, (probe, passing), _ = read(log, rig)
        counts = session.report.by_probe[0]
        new = probe.new_points
        touched = counts["/skin"].contacts
        assert touched > 50
        np.testing.assert_allclose(
            new.normal_noise,
            [radians(10)] * 50
            + [0.0, 0.0]
            + [skin] * touched
            + [radians(20)] * (len(new.known) - 52 - touched),
            rtol=1e-12,
        )
        known = new.normal_noise > 0.0
        np.testing.assert_array_equal(known, (new.normals != 0.0).any(axis=1))
        assert off(new.known[known], new.normals[known]).max() < 8.0
        assert not passing.new_points.has_normals


def test_without_normals_nothing_else_changes(log):
    none = replace(
        RIG_OF_THREE,
        bubbles=RIG.bubbles,
        clouds=(CloudRig("/lidar", "surface"), CloudRig("/skin", "contacts")),
    )
    for one, other in zip(read(log, RIG_OF_THREE)[1], read(log, none)[1], strict=True):
        assert not other.new_points.has_normals
        for name in ("free", "known", "known_sdf"):
            found, expected = (getattr(probe.new_points, name) for probe in (one, other))
            np.testing.assert_array_equal(found, expected)
        np.testing.assert_array_equal(one.contact_normals, other.contact_normals)


def test_what_a_cut_keeps_of_contacts_keeps_its_normals(log):
    """The workspace ends in the midst of the pad's contacts, of which 40 are drawn."""
    half = replace(
        RIG_OF_THREE,
        clouds=(),
        workspace=(RIG.workspace[0], (RIG.workspace[1][0], -0.012), RIG.workspace[2]),
        contact=replace(RIG.contact, points=40),
    )
    (probe, _), told = read(log, half)[1:]
    new = probe.new_points
    assert "pad: a contact left out, as it is out of the workspace" in told
    assert 5 < len(new.known) < 35
    np.testing.assert_array_equal(new.normals, probe.contact_normals)
    np.testing.assert_allclose(new.normal_noise, radians(10.0))
    assert off(new.known, new.normals).max() < 8.0
    excluded = read(log, replace(half, annotations=Annotations(exclude=(0,))))[1][0].new_points
    assert len(excluded.known) == 0


@pytest.mark.parametrize("value", [0, 0.0, -5, 181, True, "10", "off", None, float("nan"), [10]])
def test_normals_are_none_or_degrees(value):
    wanted = r"normals is .*; accepted: none, or degrees above 0, up to 180"
    settings = {"name": "mine", "world": "world"}
    sensors = {
        "bubbles": {"name": "pad", "depth": "/depth", "info": "/info"},
        "clouds": {"topic": "/skin", "role": "contacts"},
        "forces": {"topic": "/wrench"},
    }
    for name, sensor in sensors.items():
        with pytest.raises(SettingError, match=rf"session.rig.{name}.*{wanted}"):
            build_settings(
                Rig, settings | {name: [sensor | {"normals": value}]}, where="session.rig"
            )
    with pytest.raises(SettingError, match=r"normals is 10, and role rays has no points on"):
        CloudRig("/lidar", "rays", normals=10)


def test_normals_of_180_degrees_are_the_most(log):
    half_turn = replace(RIG, bubbles=(replace(RIG.bubbles[0], normals=180),))
    noise = read(log, half_turn)[1][0].new_points.normal_noise
    np.testing.assert_array_equal(noise, np.full(50, np.pi))
