"""How often judgements of poses are right, of poses whose error is known; beside inlier ratios.

python -m tests.tools.judged_poses

Our six models of real size at random poses, touched at random places of their surface with an error
of 0.5 mm, or seen by a depth camera from one side. Right poses are off by 1 mm and 1 degree. Wrong
ones are those that ICP comes to from near, turns by a half about an axis of the object's box, and
shifts by a tenth to a third of the diameter, as far as they move a vertex by more than a tenth of
the diameter, after the symmetry that suits best.
"""

import warnings

import numpy as np
import trimesh

import chsel
from chsel.plausible.symmetry import object_symmetry
from chsel.problem.poses import Poses, apply, compose, inverse, random_rotations, rotation_vector
from chsel.session.pose_judgement import CONFIRMED, CONTRADICTED
from runners.objects.loader import MODELS, load_model

COUNTS = (5, 8, 12, 20, 40)
SEEDS = range(3)
NOISE = 0.0005
WRONG = 0.1
INLIERS = 0.9
CAMERA = chsel.PinholeCamera(80, 60, fx=110.0, fy=110.0, cx=39.5, cy=29.5)


def mssd(mesh, symmetry, truth, pose):
    """The largest distance of a vertex, metres, modulo symmetries."""
    found = Poses.of(inverse(pose)[None])
    near = symmetry.nearest_copies(found, Poses.of(inverse(truth)[None])).world_from_object[0]
    off = apply(near, np.asarray(mesh.vertices)) - apply(truth, np.asarray(mesh.vertices))
    return np.sqrt((off**2).sum(axis=1)).max()


def seen(mesh, truth):
    """A depth image (H, W), and which pixels are the object's, from half a metre in front."""
    camera = compose(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), truth[:3, 3] - [0, 0.5, 0])
    rays = CAMERA.back_project(np.ones((60, 80))).reshape(-1, 3) @ camera[:3, :3].T
    posed = mesh.copy().apply_transform(truth)
    starts = np.broadcast_to(camera[:3, 3], rays.shape)
    places, index, _ = posed.ray.intersects_location(starts, rays, multiple_hits=False)
    depth = np.zeros(len(rays))
    depth[index] = apply(inverse(camera), places)[:, 2]
    mask = depth > 0.0
    depth[~mask] = 1.0
    return depth.reshape(60, 80), mask.reshape(60, 80), camera


def claims(mesh, symmetry, truth, contacts, random):
    """Poses of other estimators, and whether they are wrong."""
    diameter = mesh.scale
    right = compose(
        rotation_vector(np.radians(1.0) * random.normal(size=(1, 3)) / 3**0.5)[0] @ truth[:3, :3],
        truth[:3, 3] + 0.001 * random.normal(size=3) / 3**0.5,
    )
    middle = mesh.bounds.mean(axis=0)
    others = []
    for axis in np.eye(3):
        turn = np.diag(2.0 * axis - 1.0)
        others.append(truth @ compose(turn, middle - turn @ middle))
    for far in (0.12, 0.2, 0.33):
        way = random.normal(size=3)
        shift = far * diameter * way / np.linalg.norm(way)
        others.append(compose(truth[:3, :3], truth[:3, 3] + shift))
    starts = []
    for _ in range(3):
        turn = rotation_vector(random.normal(scale=0.7, size=(1, 3)))[0]
        place = truth[:3, 3] + random.normal(scale=0.03, size=3)
        starts.append(inverse(compose(turn @ truth[:3, :3], place)))
    found = chsel.register(mesh, contacts=contacts, method="icp", initial_set=np.array(starts))
    others += list(found.world_from_object)
    far = [one for one in others if mssd(mesh, symmetry, truth, one) > WRONG * diameter]
    return [(right, False), *[(one, True) for one in far]]


def rows():
    """Of every judged pose: how the object was perceived, whether it is wrong, the judgement."""
    for name in MODELS:
        mesh = load_model(name)
        symmetry = object_symmetry(mesh)
        for seed in SEEDS:
            random = np.random.default_rng([seed, len(name), len(mesh.faces)])
            turn = random_rotations(random, 1)[0]
            truth = compose(turn, np.array([0.3, -0.1, 0.2]))
            surface = mesh.copy().apply_transform(truth)
            places = trimesh.sample.sample_surface(surface, max(COUNTS), seed=seed)[0]
            places = places + NOISE * random.normal(size=places.shape)
            depth, mask, camera = seen(mesh, truth)
            image = {"depth": depth, "camera": CAMERA, "world_from_camera": camera, "mask": mask}
            given = {f"{count} touches": {"contacts": places[:count]} for count in COUNTS}
            for kind, what in {**given, "one depth image": image}.items():
                with chsel.Session(mesh, seed=seed) as session:
                    session.add(**what)
                    session.register()
                    known = session.points.contacts
                    for pose, wrong in claims(mesh, symmetry, truth, known, random):
                        yield kind, wrong, session.judge(pose)


def main():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = list(rows())
    few = f"under {100.0 * INLIERS:.0f} % inliers"
    print(f"| perceived | right: confirmed | contradicted | {few} ", end="")
    print(f"| wrong: confirmed | contradicted | {few} |")
    print("| :-- |" + " --: |" * 6)
    for kind in dict.fromkeys(kind for kind, *_ in found):
        cells = [kind]
        for wanted in (False, True):
            some = [one for by, wrong, one in found if by == kind and wrong == wanted]
            verdicts = [one.verdict for one in some]
            few = sum(one.inliers < INLIERS for one in some)
            counts = [verdicts.count(CONFIRMED), verdicts.count(CONTRADICTED), few]
            cells += [f"{count} of {len(some)}" for count in counts]
        print("| " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
