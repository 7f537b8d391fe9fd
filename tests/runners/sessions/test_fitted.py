"""Objects of any size are met by the probes that are laid out for them."""

import warnings

import numpy as np
import pytest
import trimesh

from chsel.errors import MeshWarning
from chsel.next_probe.action_lattice import CLEARANCE
from chsel.problem.points import FREE_RESOLUTION
from chsel.problem.poses import apply, inverse
from chsel.problem.sdf_grid import mesh_sdf
from replay.mcap.reader import read_recording
from runners import probe
from runners.objects.loader import ObjectModel, load_model
from runners.sessions import open_source
from runners.sessions.configurations import FITTED
from runners.sessions.probing import open_probing
from runners.sessions.probing_hand import panda_hand
from runners.sessions.probing_settings import ProbingSettings
from tests.chsel.samples import bracket
from tests.runners.in_process import run

LOWEST = -0.0316  # m: of the hand, below its origin
MESHES = {
    "30 mm": bracket().apply_scale(0.030 / 0.080),
    "80 mm": bracket(),
    "1 m": bracket().apply_scale(1.0 / 0.080),
    "plate": trimesh.creation.box((0.1, 0.07, 0.004)),
    "rod": trimesh.creation.cylinder(0.004, 0.3),
    "ball": trimesh.creation.icosphere(2, 0.02),
}


def probed(kind, mesh, *, settings=None):
    session = open_probing(
        kind, mesh, configuration_name=FITTED, settings=settings or ProbingSettings(), seed=0
    )
    probes = list(session.probes())
    session.close()
    return session, probes


@pytest.mark.parametrize(
    ("kind", "name"),
    [*(("kinematic", name) for name in MESHES), ("simulated", "30 mm"), ("simulated", "plate")],
)
def test_most_probes_touch_an_object_all_over(kind, name):
    mesh = MESHES[name]
    session, probes = probed(kind, mesh)
    contacts = np.concatenate([probe.contacts for probe in probes])
    assert len(probes) == session.count == 20
    assert sum(len(probe.contacts) > 0 for probe in probes) >= 12
    object_from_world = inverse(session.world_from_object)
    far = 2e-5 if kind == "kinematic" else 0.004  # m: the engine's contacts are less exact
    assert np.abs(mesh_sdf(mesh, apply(object_from_world, contacts))[0]).max() < far
    placed = apply(session.world_from_object, np.asarray(mesh.vertices))
    across = np.ptp(contacts, axis=0) / np.ptp(placed, axis=0)
    assert across[1:].min() > 0.4, across  # width and height
    lower, upper = session.workspace.bounds
    assert ((placed > lower) & (placed < upper)).all()
    free = np.concatenate([session.initial_points.free, *(p.new_points.free for p in probes)])
    assert mesh_sdf(mesh, apply(object_from_world, free))[0].min() > -0.002
    heights = np.concatenate([probe.gripper_path[:, 2, 3] for probe in probes])
    assert heights.min() + LOWEST > 0.8 * CLEARANCE  # the hand stays above the floor
    assert session.free_resolution == FREE_RESOLUTION


def test_the_settings_of_free_voxels_hold():
    settings = ProbingSettings(free_resolution=0.02)
    session = open_probing(
        "kinematic", bracket(), configuration_name=FITTED, settings=settings, seed=0
    )
    assert session.free_resolution == 0.02
    assert open_probing(
        "kinematic", bracket(), configuration_name="drill", settings=ProbingSettings(), seed=0
    ).free_resolution == (0.025)


def test_probes_that_are_laid_out_for_another_size_are_a_warning():
    small = ObjectModel(
        "drill", load_model("drill", 1.0), scale=1.0, epsilon=0.001, configuration="drill"
    )
    with pytest.warns(MeshWarning, match="configuration drill is laid out .* paper's size"):
        open_source("kinematic", ProbingSettings(), object_model=small, seed=0)
    large = ObjectModel(
        "drill",
        load_model("drill", 2.5),
        scale=2.5,
        epsilon=0.001,
        configuration="drill",
        of_paper=True,
    )
    with warnings.catch_warnings(action="error"):
        open_source("kinematic", ProbingSettings(), object_model=large, seed=0)
        open_source("kinematic", ProbingSettings(configuration=FITTED), object_model=small, seed=0)


def test_the_hand_is_the_one_that_is_meant():
    bounds = np.array([solid.bounds for solid in panda_hand().solids])
    assert bounds[:, 0, 2].min() == pytest.approx(LOWEST)


@pytest.mark.parametrize("size", ["30 mm", "80 mm"])
def test_a_mesh_of_ones_own_is_found_by_the_kinematic_hand(size, tmp_path):
    """By default; what is determined is right, within 3 % of the diameter."""
    mesh = MESHES[size]
    mesh.export(tmp_path / "mesh.stl")
    done = run(
        probe.main,
        *("object=mesh", f"object.path={tmp_path / 'mesh.stl'}", "session=kinematic"),
        *("method=anchored", "session.start_probe=19", "recording=mcap", f"logs={tmp_path}"),
    )
    assert done.returncode == 0, done.stderr
    (path,) = tmp_path.rglob("recording.mcap")
    recording = read_recording(path)
    config = recording.start.config["session"]
    assert (config["object_resolution"], config["free_resolution"]) == (None, FREE_RESOLUTION)
    hypotheses = recording.hypotheses(19)
    truth = recording.start.world_from_object
    points = trimesh.sample.sample_surface(mesh, 300, seed=0)[0]
    off = [
        np.linalg.norm(apply(truth, points) - apply(inverse(pose), points), axis=1).mean()
        for pose in hypotheses.object_from_world
    ]
    diameter = float(np.linalg.norm(mesh.extents))
    assert min(off) < 0.03 * diameter
    if "determined" in done.stdout.splitlines()[-1]:
        assert off[0] < 0.03 * diameter
