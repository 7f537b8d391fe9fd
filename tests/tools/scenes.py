"""How often touches are given to the right object in scenes of several, and where these are found.

python -m tests.tools.scenes OBJECTS SEEDS      # such as 2 300..319

Our models of real size stand upright at random places, at least 15 mm apart. A finger of 16 mm goes
straight until it meets something, for each object in turn: first past its middle, then where
`scene.next_probe` says. It ends after eight touches for each object. Beside it are registrations
of the touches that truly are on an object, and of all touches as if they were on it.
"""

import sys
import warnings
from dataclasses import dataclass, field

import numpy as np
import trimesh

import chsel
from chsel.problem.noise import LIMIT
from chsel.problem.poses import Poses, apply, axis_angle, compose, inverse
from chsel.problem.surface import outline_distances_to
from runners.objects.loader import MODELS, load_model
from runners.sessions.kinematic import KinematicEngine
from runners.sessions.probing_hand import ROTATION, ProbingHand
from runners.sessions.probing_settings import ProbingSettings

EACH = 8  # touches
STEP = 0.005  # metres, of the finger
GAP = 0.015
NEAR = 0.010
TRIED = 40  # probes of each object, at most
FINGER = trimesh.creation.box(bounds=[[-0.008, -0.008, -0.10], [0.008, 0.008, 0.0]])
WORKSPACE = chsel.Workspace((-0.35, -0.35, 0.0), (0.35, 0.35, 0.35))
POLICY = {"stop": {"gain": 0.0, "spread": 0.0}}


@dataclass
class Found:
    """What was found in one scene."""

    names: list
    owners: list = field(default_factory=list)  # true ones, of each touch
    rows: list = field(default_factory=list)  # touches, share of them given rightly, margin
    near: dict = field(default_factory=dict)  # by way: whether the best pose of each is near


def placed(names, random):
    """Poses world_from_object by name, and the meshes there."""
    poses = {}
    solids = []
    for name in names:
        mesh = load_model(name)
        while True:
            pose = compose(axis_angle(np.array([0.0, 0.0, 1.0]), random.uniform(-np.pi, np.pi)), 0)
            low = apply(pose, np.asarray(mesh.vertices))[:, 2].min()
            pose[:3, 3] = [*random.uniform(-0.18, 0.18, 2), -low]
            there = mesh.copy().apply_transform(pose)
            points = there.sample(300, seed=int(random.integers(2**31)))
            gaps = [-trimesh.proximity.signed_distance(other, points).max() for other in solids]
            if all(gap > GAP for gap in gaps):
                break
        poses[name] = pose
        solids.append(there)
    return poses, solids


def pushed(engine, start, length):
    """The path of the finger from a pose, and the contact or None; None where it begins inside."""
    if not engine.place(start):
        return None
    touch = None
    for way in np.arange(STEP, length + STEP, STEP):
        touch = engine.advance(start[:3, 3] + way * start[:3, 2])
        if touch.contact is not None:
            break
    end = start.copy()
    end[:3, 3] = touch.position
    return np.stack([start, end]), touch.contact


def is_near(sdf, object_from_world, truth):
    off = outline_distances_to(
        sdf, Poses.of(object_from_world[:1]), other=Poses.of(inverse(truth[None]))
    )
    return bool(off[0] < NEAR)


def run(seed, count):
    random = np.random.default_rng(seed)
    names = [str(name) for name in random.choice(MODELS, count, replace=False)]
    truths, solids = placed(names, random)
    hand = ProbingHand([trimesh.Trimesh(FINGER.vertices @ ROTATION.T, FINGER.faces)])
    engine = KinematicEngine(
        trimesh.util.concatenate(solids), np.eye(4), settings=ProbingSettings(), hand=hand
    )
    meshes = {name: load_model(name) for name in names}
    policy = chsel.build_policy("expected_loss", POLICY)
    found = Found(names)
    contacts = []
    with chsel.Scene(meshes, workspace=WORKSPACE, hand=FINGER, policy=policy) as scene:
        actions = scene.sessions[names[0]].actions()
        taken = set()
        for n in range(TRIED * count):
            asked = names[n % count]
            one = scene.objects.get(asked)
            probe = scene.next_probe(asked) if one is not None and one.answer is not None else None
            if probe is None:
                middle = solids[n % count].bounds.mean(axis=0)
                off = middle - actions.world_from_hand[:, :3, 3]
                along = actions.world_from_hand[:, :3, 2]
                aside = np.linalg.norm(off - (off * along).sum(1, keepdims=True) * along, axis=1)
                left = np.array([i not in taken for i in range(len(actions))])
                past = left & (aside < 0.05)
                chosen = random.choice(np.flatnonzero(past if past.any() else left))
                taken.add(int(chosen))
                way = actions.world_from_hand[chosen], float(actions.length[chosen])
            else:
                way = probe.world_from_hand, probe.length
            pushes = pushed(engine, *way)
            if pushes is None:
                continue
            path, contact = pushes
            scene.add(hand=FINGER, path=path, contact=contact)
            if contact is None:
                continue
            away = [abs(trimesh.proximity.signed_distance(s, contact[None])[0]) for s in solids]
            found.owners.append(names[int(np.argmin(away))])
            contacts.append(contact)
            if len(contacts) < 3:
                continue
            scene.register()
            right = np.mean([a == b for a, b in zip(scene.owners, found.owners, strict=True)])
            found.rows.append((len(contacts), float(right), scene.margin))
            if len(contacts) == EACH * count:
                break
        measure(scene, found, np.array(contacts), truths=truths)
    return found


def measure(scene, found, contacts, *, truths):
    """Say whether the best pose of each object that was touched is near, by the scene and alone."""
    for name in set(found.owners):
        session = scene.sessions[name]
        sdf = session.started.sdf
        own = np.array([owner == name for owner in found.owners])
        best = scene.objects[name].world_from_object
        by_scene = best is not None and is_near(sdf, inverse(best[None]), truths[name])
        found.near.setdefault("scene", []).append(by_scene)
        for way, some in (("alone", contacts[own]), ("all", contacts)):
            free = session.points.free
            answer = chsel.register(sdf, contacts=some, free=free, workspace=WORKSPACE)
            near = is_near(sdf, answer.object_from_world, truths[name])
            found.near.setdefault(way, []).append(near)


def main():
    count = int(sys.argv[1])
    first, _, last = sys.argv[2].partition("..")
    every = []
    for seed in range(int(first), int(last or first) + 1):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            one = run(seed, count)
        every.append(one)
        touches, right, margin = one.rows[-1]
        print(f"{seed}: {', '.join(one.names)}: {touches} touches, right {right:.2f}, ", end="")
        print(f"margin {margin:.1f}, near {one.near}", flush=True)
    for way in ("scene", "alone", "all"):
        near = [flag for one in every for flag in one.near[way]]
        print(f"best pose within 10 mm, {way}: {sum(near)} of {len(near)}")
    print(f"touches given rightly at the end: {np.mean([one.rows[-1][1] for one in every]):.3f}")
    rows = [row for one in every for row in one.rows]
    for name, some in (
        ("above", [right for _, right, margin in rows if margin > LIMIT]),
        ("up to", [right for _, right, margin in rows if margin <= LIMIT]),
    ):
        print(f"all rightly at a margin {name} {LIMIT:g}: {some.count(1.0)} of {len(some)}")


if __name__ == "__main__":
    main()
