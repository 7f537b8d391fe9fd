"""A dataset in the layout of the BOP challenge: one scene, of which a camera sees two boxes."""

import json

import numpy as np
import trimesh
from PIL import Image

from chsel.problem.poses import compose, inverse, rotation_vector

SIDES = (120.0, 70.0, 40.0)  # millimetres
SHAPE = (120, 160)
K = [200.0, 0.0, 79.5, 0.0, 200.0, 59.5, 0.0, 0.0, 1.0]
SCALE = 0.1  # millimetres of a unit of depth
POSES = {
    4: compose(rotation_vector(np.array([0.7, 0.4, 0.3])), np.array([-60.0, 10.0, 500.0])),
    9: compose(rotation_vector(np.array([-0.5, 0.9, -0.2])), np.array([80.0, -20.0, 560.0])),
}
WALL = 800.0  # millimetres


def write_bop(folder):
    """The dataset: scene 2, image 7, object 4 and object 9, which are alike."""
    scene = folder / "test" / "000002"
    for name in ("depth", "mask_visib"):
        (scene / name).mkdir(parents=True)
    (folder / "models").mkdir()
    info = {}
    for object_id in POSES:
        trimesh.creation.box(SIDES).export(folder / "models" / f"obj_{object_id:06d}.ply")
        turns = [np.diag([*np.roll([1.0, -1.0, -1.0], n), 1.0]) for n in range(3)]
        info[str(object_id)] = {
            "diameter": float(np.linalg.norm(SIDES)),
            "symmetries_discrete": [turn.ravel().tolist() for turn in turns],
        }
    (folder / "models" / "models_info.json").write_text(json.dumps(info))
    depth = np.full(SHAPE, WALL)
    nearest = {}
    for object_id, pose in POSES.items():
        nearest[object_id] = box_depth(pose)
        depth = np.minimum(depth, nearest[object_id])
    for number, object_id in enumerate(POSES):
        mask = (nearest[object_id] == depth).astype(np.uint8) * 255
        Image.fromarray(mask).save(scene / "mask_visib" / f"000007_{number:06d}.png")
    stored = np.rint(depth / SCALE).astype(np.uint16)
    Image.fromarray(stored).save(scene / "depth" / "000007.png")
    truths = [
        {
            "obj_id": object_id,
            "cam_R_m2c": pose[:3, :3].ravel().tolist(),
            "cam_t_m2c": pose[:3, 3].tolist(),
        }
        for object_id, pose in POSES.items()
    ]
    (scene / "scene_gt.json").write_text(json.dumps({"7": truths}))
    camera = {"7": {"cam_K": K, "depth_scale": SCALE}}
    (scene / "scene_camera.json").write_text(json.dumps(camera))
    return folder


def box_depth(pose):
    """Depth (H, W) of the box at a pose, millimetres; infinite beside it: of rays and slabs."""
    rows, columns = np.indices(SHAPE)
    rays = np.stack([(columns - K[2]) / K[0], (rows - K[5]) / K[4], np.ones(SHAPE)], axis=-1)
    to_box = inverse(pose)
    origin = to_box[:3, 3]
    rays = rays @ to_box[:3, :3].T
    half = 0.5 * np.array(SIDES)
    one, other = (-half - origin) / rays, (half - origin) / rays
    enters = np.minimum(one, other).max(axis=-1)
    leaves = np.maximum(one, other).min(axis=-1)
    return np.where((enters < leaves) & (enters > 0.0), enters, np.inf)
