"""A session of points on a box, for commands."""

import re

import numpy as np
import trimesh

from chsel.problem.poses import apply, axis_angle, compose
from runners import probe
from tests.runners.in_process import run

BOX = trimesh.creation.box((0.1, 0.06, 0.2))
POSE = compose(axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.5)), np.array([0.1, 0.2, 0.3]))


def points_session(folder, probes=6, *, contacts=5, **more):
    """Write a file of points and a mesh to `folder`; the overrides of runners.probe for them.

    contacts: new ones in each probe. more: arrays of the file; None leaves one out.
    """
    BOX.export(folder / "box.ply")
    arrays = {
        "surface": apply(POSE, trimesh.sample.sample_surface(BOX, contacts * probes, seed=0)[0]),
        "surface_step": np.arange(contacts * probes) // contacts,
        "free": np.random.default_rng(0).uniform(0.3, 0.6, (10 * probes, 3)),
        "free_step": np.arange(10 * probes) % probes,
        "world_from_object": POSE,
    }
    given = {name: array for name, array in (arrays | more).items() if array is not None}
    np.savez(folder / "box.npz", **given)
    paths = f"session.path={folder / 'box.npz'}", f"object.path={folder / 'box.ply'}"
    return ("session=points", "session.object_resolution=0.01", "object=mesh", *paths)


def recorded_box(folder, **points):
    """The recording of two probes of such a session, registered by gradient descent."""
    overrides = points_session(folder, 2, **points)
    quick = ("object.epsilon=0.002", "method=gradient_descent", "recording=mcap")
    done = run(probe.main, *overrides, *quick, f"logs={folder / 'logs'}")
    assert done.returncode == 0, done.stderr
    (recording,) = (folder / "logs").rglob("recording.mcap")
    return recording


def reported_probes(output):
    """How many whole lines of a session's output are about a probe that is done."""
    return len(re.findall(r"^probe +\d+ .*\n", output, re.MULTILINE))
