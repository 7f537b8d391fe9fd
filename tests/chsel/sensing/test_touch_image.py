"""Touch images of presses whose shape is known."""

import numpy as np
import pytest
import trimesh

import chsel
from chsel.errors import PointsError, PoseError, SettingError
from chsel.problem.poses import apply, compose, inverse, rotation_vector
from chsel.sensing.touch_image import touch_points

PIXEL = 0.0001  # metres
SHAPE = (160, 200)
POSE = compose(rotation_vector(np.array([0.3, -1.2, 0.5])), np.array([0.4, -0.2, 0.7]))


def sensor_places():
    """x and y (H, W) of the pixels in the sensor's frame, metres."""
    rows, columns = np.indices(SHAPE)
    return PIXEL * (columns - 0.5 * (SHAPE[1] - 1)), PIXEL * (rows - 0.5 * (SHAPE[0] - 1))


def angles(found, expected):
    """Degrees between unit vectors (M, 3)."""
    return np.degrees(np.arccos(np.clip((found * expected).sum(axis=1), -1.0, 1.0)))


def in_sensor(points):
    return (points - POSE[:3, 3]) @ POSE[:3, :3]


def test_a_sphere_is_met_to_a_tenth_of_a_millimetre_and_3_degrees():
    """It reaches 1 mm into the gel; its surface is where the gel is pressed to."""
    radius, centre = 0.012, np.array([0.001, -0.0005, 0.011])
    x, y = sensor_places()
    squared = radius**2 - (x - centre[0]) ** 2 - (y - centre[1]) ** 2
    pressed = np.sqrt(np.maximum(squared, 0.0)) - centre[2]
    touched = pressed > 0.0
    noise = np.random.default_rng(0).normal(0.0, 5e-6, SHAPE)
    found = touch_points(
        np.where(touched, np.maximum(pressed + noise, 0.0), 0.0),
        touched,
        pixel=PIXEL,
        world_from_sensor=POSE,
    )
    away = in_sensor(found.points) - centre
    distance = np.sqrt((away**2).sum(axis=1))
    assert np.abs(distance - radius).max() < 1e-4
    known = np.abs(found.normals).sum(axis=1) > 0.0
    assert 5 < known.sum() < len(known)  # not at the border, where the gel is not the object
    out = found.normals[known] @ POSE[:3, :3]
    assert angles(out, away[known] / distance[known, None]).max() < 3.0
    assert (out[:, 2] < 0.0).all()  # towards the sensor


def test_the_edge_of_a_box_has_the_normals_of_its_faces_and_none_between():
    """Faces that fall off by 35 and 50 degrees on both sides of an edge along y."""
    x, _ = sensor_places()
    one, other = np.radians([35.0, 50.0])
    pressed = 0.002 - np.where(x < 0.0, -x * np.tan(one), x * np.tan(other))
    touched = pressed > 0.0
    found = touch_points(
        np.maximum(pressed, 0.0), touched, pixel=PIXEL, world_from_sensor=POSE, spacing=0.0008
    )
    places = in_sensor(found.points)
    known = np.abs(found.normals).sum(axis=1) > 0.0
    left = places[:, 0] < 0.0
    off_edge = np.where(
        left,
        np.abs(places[:, 2] + 0.002 + places[:, 0] * np.tan(one)) * np.cos(one),
        np.abs(places[:, 2] + 0.002 - places[:, 0] * np.tan(other)) * np.cos(other),
    )
    assert off_edge.max() < 1e-9
    out = found.normals @ POSE[:3, :3]
    faces = np.where(
        left[:, None], [-np.sin(one), 0, -np.cos(one)], [np.sin(other), 0, -np.cos(other)]
    )
    assert angles(out[known], faces[known]).max() < 3.0
    at_edge = np.abs(places[:, 0]) < 2.0 * PIXEL
    assert at_edge.any()
    assert not known[at_edge].any()
    assert known[left].any()
    assert known[~left].any()


def test_a_flat_press_is_all_contact_and_pixels_without_a_height_are_none():
    found = touch_points(np.full(SHAPE, 0.0005), pixel=PIXEL, world_from_sensor=np.eye(4))
    np.testing.assert_allclose(found.points[:, 2], -0.0005)
    assert len(found.points) == 8 * 10  # one on each 2 mm
    np.testing.assert_allclose(found.points.mean(axis=0)[:2], 0.0, atol=PIXEL)
    known = np.abs(found.normals).sum(axis=1) > 0.0
    np.testing.assert_allclose(found.normals[known] - [0.0, 0.0, -1.0], 0.0, atol=1e-15)
    height = np.full(SHAPE, np.nan)
    height[50:60, 50:60] = 0.001
    few = touch_points(height, pixel=PIXEL, world_from_sensor=np.eye(4))
    assert 1 <= len(few.points) <= 4


def test_the_set_of_a_box_that_was_pressed_on_four_faces_holds_the_truth():
    """Each press is near a corner, where a part of the gel reaches beyond the face."""
    sides = np.array([0.06, 0.09, 0.14])
    session = chsel.Session(trimesh.creation.box(sides), seed=0)
    for axis, sign in ((0, 1.0), (1, -1.0), (2, 1.0), (0, -1.0)):
        inward = -sign * np.eye(3)[axis]
        along = np.eye(3)[(axis + 1) % 3]
        rotation = np.stack([along, np.cross(inward, along), inward], axis=1)
        corner = 0.5 * sides - 0.004
        place = corner * [1.0, -1.0, 1.0]
        place[axis] = sign * (0.5 * sides[axis] - 0.001)  # 1 mm inside of the face
        object_from_sensor = compose(rotation, place)
        x, y = sensor_places()
        touched = (
            np.abs(apply(object_from_sensor, np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3)))
            <= 0.5 * sides
        ).all(axis=1)
        found = touch_points(
            np.full(SHAPE, 0.001),
            touched.reshape(SHAPE),
            pixel=PIXEL,
            world_from_sensor=POSE @ object_from_sensor,
        )
        session.add(contacts=found.points, normals=found.normals, normal_noise=0.05)
    poses = inverse(session.register().object_from_world)
    errors = inverse(POSE) @ poses
    angle = np.degrees(np.arccos(np.clip(np.abs(errors[:, [0, 1, 2], [0, 1, 2]]), 0, 1))).max(
        axis=1
    )
    off = np.sqrt((errors[:, :3, 3] ** 2).sum(axis=1))
    assert ((off < 0.003) & (angle < 3.0)).any()


@pytest.mark.parametrize(
    ("height", "contact", "message"),
    [
        (np.zeros((4, 5)), None, "no pixel is in contact; accepted: a touch"),
        (
            np.ones((4, 5)),
            None,
            "height is from 1 to 1 in contact; accepted: from 0 to 0.02 metres",
        ),
        (np.zeros(4), None, r"height has shape \(4,\); accepted: \(H, W\)"),
        (np.zeros((0, 5)), None, r"height has shape \(0, 5\); accepted"),
        (np.full((4, 5), np.nan), np.ones((4, 5), bool), "height is from nan to nan in contact"),
        (np.zeros((4, 5)), np.ones((4, 5)), r"contact has shape \(4, 5\) of float64; accepted"),
        (np.zeros((4, 5)), np.ones((5, 4), bool), r"accepted: \(4, 5\) of bool, as height"),
    ],
)
def test_an_image_that_cannot_be_read_is_one_line(height, contact, message):
    with pytest.raises(PointsError, match=message):
        touch_points(height, contact, pixel=PIXEL, world_from_sensor=np.eye(4))


def test_other_mistakes_are_named():
    image = np.full((4, 5), 0.001)
    with pytest.raises(SettingError, match="pixel is 0"):
        touch_points(image, pixel=0.0, world_from_sensor=np.eye(4))
    with pytest.raises(PoseError, match="world_from_sensor"):
        touch_points(image, pixel=PIXEL, world_from_sensor=2.0 * np.eye(4))
