"""The simulated session, in both engines, beside the geometry of the kinematic one."""

import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest
import trimesh

from chsel.errors import MeshWarning, SessionError, SettingError
from chsel.events import Probe
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import apply, compose, inverse
from chsel.problem.sdf_grid import mesh_sdf
from runners.objects.loader import load_model
from runners.sessions import mujoco_engine, physics_engine
from runners.sessions.configurations import CONFIGURATIONS, FITTED
from runners.sessions.physics_engine import ENGINES
from runners.sessions.placement import laid_down, lowest
from runners.sessions.probing import open_probing
from runners.sessions.probing_hand import ROTATION, panda_hand
from runners.sessions.probing_settings import ProbingSettings

SCALES = {"cracker_box": 1.5, "clamp": 5.0}
AGREEMENT = 0.003  # m
SETTLED = {"mujoco": 0.0001, "pybullet": 0.001}  # m
PRESSED = 0.0005  # m: how far 30 N press the hand into the object before the engine resists

MANY = ("clamp_sideways", "drill", "drill_fallen", "hammer", "hammer_fallen", "mustard_fallen")
FEW = ("box", "can", "clamp", "mustard")  # of those with PyBullet, which takes longer

DIGESTS = """
import sys
from runners.objects.loader import load_model
from runners.sessions.probing_settings import ProbingSettings
from runners.sessions.probing import open_probing
model = load_model("spam_can", 2.5)
settings = ProbingSettings(engine=sys.argv[1])
session = open_probing("simulated", model, configuration_name="can", settings=settings, seed=5)
print(session.world_from_object.tobytes().hex(), session.initial_points.digest)
for probe, _ in zip(session.probes(), range(4)):
    print(probe.new_points.digest, probe.gripper_path.tobytes().hex()[-200:], probe.outcome)
"""


@dataclass(frozen=True, eq=False)
class _Pair:
    """One configuration, probed by both engines."""

    mesh: trimesh.Trimesh
    world_from_object: FloatArray
    simulated: list[Probe]
    kinematic: list[Probe]


def _mesh(configuration_name):
    name = CONFIGURATIONS[configuration_name].object
    return load_model(name).apply_scale(SCALES.get(name, 2.5))


def _pairs():
    """All configurations in both engines; in each some at every commit."""
    for engine, often in (("mujoco", {*MANY, *FEW}), ("pybullet", FEW)):
        for name in CONFIGURATIONS:
            marks = () if name in often else pytest.mark.slow
            yield pytest.param((engine, name), id=f"{engine}-{name}", marks=marks)


@pytest.fixture(scope="module", params=_pairs())
def pair(request):
    engine, name = request.param
    pytest.importorskip(engine, reason=f"{engine} is not installed")
    mesh = _mesh(name)
    simulated, kinematic = (
        open_probing(kind, mesh, configuration_name=name, settings=settings, seed=0)
        for kind, settings in (
            ("simulated", ProbingSettings(engine=engine)),
            ("kinematic", ProbingSettings()),
        )
    )
    both = list(simulated.probes()), list(kinematic.probes())
    simulated.close()
    return _Pair(mesh, simulated.world_from_object, simulated=both[0], kinematic=both[1])


def test_contacts_agree_with_plain_geometry_to_3_mm(pair):
    distances = []
    for simulated, kinematic in zip(pair.simulated, pair.kinematic, strict=True):
        assert simulated.outcome == kinematic.outcome
        for contact in simulated.contacts:
            patch = np.concatenate([kinematic.contacts, _touching(pair, kinematic, near=contact)])
            assert _distances(contact, patch).min() < AGREEMENT
            distances.append(_distances(contact, kinematic.contacts).min())
    # Where faces lie nearly flat on one another, one engine's point can be anywhere in the patch
    # that touches, so single points are only held to agree for the most part.
    assert np.median(distances) < AGREEMENT
    assert max(distances) < 0.010


def _touching(pair, probe, *, near):
    """Where on the object (N, 3) the hand of a probe, at its furthest, all but touches it."""
    ends = probe.gripper_path[:, :3, 3]
    surface = panda_hand().surface_points(0.001) + ends[np.argmax(ends[:, 0])]
    surface = surface[_distances(near, surface) < 0.02]
    points = apply(inverse(pair.world_from_object), surface)
    distance, normal = mesh_sdf(pair.mesh, points)
    onto = points - distance[:, None] * normal
    return apply(pair.world_from_object, onto[distance < PRESSED])


def _distances(point, points):
    return np.sqrt(((points - point) ** 2).sum(axis=1))


def test_each_configuration_has_four_contacts_all_of_them_on_the_surface(pair):
    contacts = np.concatenate([probe.contacts for probe in pair.simulated])
    assert len(contacts) >= 4
    points = apply(inverse(pair.world_from_object), contacts)
    assert np.abs(mesh_sdf(pair.mesh, points)[0]).max() < 0.001


def test_free_space_is_nearly_that_of_plain_geometry(pair):
    free, other = (
        np.concatenate([probe.new_points.free for probe in probes])
        for probes in (pair.simulated, pair.kinematic)
    )
    assert len(free) == pytest.approx(len(other), rel=0.01)
    assert len(free) > 2000
    tolerance = 0.5 * np.sqrt(3.0) * 0.025 - 0.010
    inside = mesh_sdf(pair.mesh, apply(inverse(pair.world_from_object), free))[0]
    assert inside.min() > -tolerance


def test_the_settled_object_lies_on_the_floor_where_geometry_has_laid_it(pair, request):
    assert lowest(pair.mesh, pair.world_from_object) == pytest.approx(0.0, abs=1e-9)
    engine, name = request.node.callspec.params["pair"]
    laid = laid_down(pair.mesh, CONFIGURATIONS[name])
    vertices = np.asarray(pair.mesh.vertices)
    moved = apply(pair.world_from_object, vertices) - apply(laid, vertices)
    assert np.sqrt((moved**2).sum(axis=1)).max() < SETTLED[engine]


@pytest.mark.parametrize("engine", ENGINES)
def test_a_hand_inside_or_across_the_surface_is_at_no_clear_start(engine):
    pytest.importorskip(engine, reason=f"{engine} is not installed")
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.0)  # m: longer than the hand
    settings = ProbingSettings(engine=engine)
    session = open_probing("simulated", ball, configuration_name=FITTED, settings=settings, seed=0)
    centre = session.world_from_object[:3, 3]
    offsets = ([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [-1.5, 0.0, 0.0])
    clear = [session._engine.place(compose(ROTATION, centre + offset)) for offset in offsets]
    session.close()
    assert clear == [False, False, True]


@pytest.mark.parametrize("engine", ENGINES)
def test_a_seed_gives_the_same_bytes_in_every_process(engine):
    pytest.importorskip(engine, reason=f"{engine} is not installed")
    command = [sys.executable, "-c", DIGESTS, engine]
    outputs = [subprocess.check_output(command, text=True) for _ in range(2)]
    assert outputs[0] == outputs[1]
    assert outputs[0].count("\n") == 5
    assert "contact" in outputs[0]


def test_a_mesh_that_pybullet_cannot_hold_is_one_line():
    pytest.importorskip("pybullet", reason="pybullet is not installed")
    ball = trimesh.creation.icosphere(subdivisions=7, radius=0.1)
    settings = ProbingSettings(engine="pybullet")
    with pytest.raises(SessionError, match=r"hold the object's mesh of 327680 faces .*=mujoco or"):
        open_probing("simulated", ball, configuration_name=FITTED, settings=settings, seed=0)


def test_contacts_can_be_with_the_convex_parts(capfd):
    pytest.importorskip("pybullet", reason="pybullet is not installed")
    settings = ProbingSettings(collision_mesh="vhacd", engine="pybullet")
    session = open_probing(
        "simulated", _mesh("can"), configuration_name="can", settings=settings, seed=0
    )
    assert len(next(session.probes()).contacts) >= 1
    session.close()
    assert capfd.readouterr().out == ""  # the decomposition is talkative


def test_a_mesh_of_many_faces_is_told(monkeypatch):
    mesh = _mesh("can")
    settings = ProbingSettings(engine="mujoco")
    monkeypatch.setattr(mujoco_engine, "_MANY_FACES", len(mesh.faces) - 1)
    with pytest.warns(
        MeshWarning, match=rf"the mesh has {len(mesh.faces)} faces, for which MuJoCo"
    ):
        open_probing("simulated", mesh, configuration_name="can", settings=settings, seed=0)


def test_mujoco_touches_the_mesh_itself():
    settings = ProbingSettings(collision_mesh="vhacd", engine="mujoco")
    with pytest.raises(SettingError, match="collision_mesh is vhacd; accepted in mujoco: visual"):
        open_probing("simulated", _mesh("can"), configuration_name="can", settings=settings, seed=0)


@pytest.mark.parametrize("engine", ENGINES)
def test_an_engine_that_is_not_installed_is_one_line_with_the_other_sessions(engine, monkeypatch):
    (other,) = {*ENGINES} - {engine}
    missing = {engine}
    monkeypatch.setattr(physics_engine, "find_spec", lambda name: None if name in missing else 1)
    with pytest.raises(
        SessionError,
        match=f"engine {engine} is not installed .*: session.engine={other} or session=kinematic",
    ):
        open_probing(
            "simulated",
            _mesh("can"),
            configuration_name="can",
            settings=ProbingSettings(engine=engine),
            seed=0,
        )
    assert physics_engine.default_engine() == other
    missing |= {other}
    with pytest.raises(SessionError, match=r"is not installed .*; accepted: session=kinematic"):
        open_probing(
            "simulated", _mesh("can"), configuration_name="can", settings=ProbingSettings(), seed=0
        )
