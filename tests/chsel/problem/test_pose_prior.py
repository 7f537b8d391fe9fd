"""A prior on the pose costs what its equation says, and is bounded, checked and carried."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from chsel.errors import PoseError, SettingError
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.pose_prior import WRONG, PosePrior, centre_of, prior_from_settings
from chsel.problem.poses import Poses, axis_angle, compose, inverse, rotation_vector
from chsel.problem.pushes import Pushes
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem, check_prior
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey

CONFIDENT = {"centre": [0.3, -0.1, 0.05], "centre_noise": 0.02}
UPRIGHT = {"axis": [0.0, 0.0, 2.0], "along": [0.0, 0.0, 1.0], "axis_noise": 0.1}


@pytest.fixture(scope="module")
def sdf() -> SdfGrid:
    box = trimesh.creation.box((0.06, 0.04, 0.1))
    return SdfGrid.from_mesh(box, resolution=0.005, padding=0.03)


def turned(axis, degrees, position):
    """Return object_from_world (4, 4) of an object that is turned, with its origin somewhere."""
    rotation = axis_angle(np.asarray(axis, dtype=float), np.radians(degrees))
    return inverse(compose(rotation, np.asarray(position, dtype=float)))


def poses_of(*transforms) -> Poses:
    return Poses.of(np.array(transforms))


def bounded(q):
    return -np.log((1.0 - np.exp(-WRONG)) * np.exp(-q) + np.exp(-WRONG))


def estimated(count=3, seed=0):
    """Return poses and full covariances of an estimator."""
    stream = np.random.default_rng(seed)
    poses = inverse(
        compose(rotation_vector(stream.normal(size=(count, 3))), stream.normal(size=(count, 3)))
    )
    roots = stream.normal(size=(count, 6, 6)) * np.repeat([0.01, 0.1], 3)[:, None]
    return poses, roots @ np.swapaxes(roots, 1, 2) + np.diag(np.repeat([1e-5, 1e-3], 3))


def test_a_point_off_its_centre_costs_half_its_squared_noise_levels(sdf):
    prior = PosePrior(**CONFIDENT, point=[0.0, 0.0, 0.05])
    here = turned([1, 0, 0], 90.0, [0.3, -0.05, 0.05])  # z of the object is -y of the world
    off = turned([1, 0, 0], 90.0, [0.3, -0.05 + 0.03, 0.05])
    energies = prior.energies(poses_of(here, off), sdf)
    np.testing.assert_allclose(energies, [0.0, bounded(0.5 * 1.5**2)], atol=1e-12)


def test_without_a_point_the_centre_is_that_of_the_object(sdf):
    prior = PosePrior(**CONFIDENT)
    there = np.array(CONFIDENT["centre"]) - centre_of(sdf)
    assert np.abs(centre_of(sdf)).max() < 0.005
    pose = poses_of(turned([0, 0, 1], 0.0, there))
    assert prior.energies(pose, sdf)[0] == pytest.approx(0.0, abs=1e-12)


def test_a_tilt_by_the_root_mean_square_angle_costs_one_nat(sdf):
    prior = PosePrior(**UPRIGHT)
    angles = np.degrees([0.0, 0.1, 0.3])
    poses = poses_of(*[turned([0.6, 0.8, 0.0], angle, [1.0, 2.0, 3.0]) for angle in angles])
    q = 2.0 * (1.0 - np.cos([0.0, 0.1, 0.3])) / 0.1**2
    np.testing.assert_allclose(prior.energies(poses, sdf), bounded(q), atol=1e-12)
    assert q[1] == pytest.approx(1.0, abs=1e-3)


def test_a_turn_about_the_axis_costs_nothing(sdf):
    prior = PosePrior(**UPRIGHT)
    poses = poses_of(*[turned([0, 0, 1], angle, [0.1, 0.2, 0.3]) for angle in (10.0, 120.0, 180.0)])
    np.testing.assert_allclose(prior.energies(poses, sdf), 0.0, atol=1e-12)


def test_poses_of_another_estimator_cost_as_a_mixture_of_gaussians(sdf):
    others, covariances = estimated()
    weights = np.array([1.0, 2.0, 5.0])
    prior = PosePrior(object_from_world=others, covariances=covariances, weights=weights)
    np.testing.assert_allclose(prior.weights, weights / 8.0)
    stream = np.random.default_rng(1)
    world = inverse(others)
    near = np.repeat(np.arange(3), 5)
    turns = Rotation.from_rotvec(stream.normal(size=(15, 3)) * 0.2).as_matrix()
    shifts = stream.normal(size=(15, 3)) * 0.01
    queries = inverse(compose(turns @ world[near, :3, :3], world[near, :3, 3] + shifts))

    def density(pose):
        middle = np.append(centre_of(sdf), 1.0)
        total = 0.0
        for other, covariance, weight in zip(world, covariances, weights, strict=True):
            place = (inverse(pose[None])[0] @ middle - other @ middle)[:3]
            turn = Rotation.from_matrix(pose[:3, :3].T @ other[:3, :3].T).as_rotvec()
            offset = np.concatenate([place, turn])
            total += weight * multivariate_normal(cov=covariance).pdf(offset)
        return total

    highest = max(density(pose) for pose in others)
    q = [-np.log(min(density(pose) / highest, 1.0)) for pose in queries]
    assert sum(1.0 < each < 6.0 for each in q) >= 3
    energies = prior.energies(Poses.of(queries), sdf)
    np.testing.assert_allclose(energies, bounded(np.array(q)), rtol=1e-9)
    assert prior.energies(Poses.of(others), sdf).min() == pytest.approx(0.0, abs=1e-12)


def test_a_prior_costs_at_most_what_a_wrong_one_does(sdf):
    others, covariances = estimated(1)
    prior = PosePrior(**CONFIDENT, **UPRIGHT, object_from_world=others, covariances=covariances)
    far = poses_of(turned([1, 0, 0], 180.0, [100.0, 0.0, 0.0]))
    assert prior.energies(far, sdf)[0] == pytest.approx(WRONG, abs=1e-12)


def test_parts_of_a_prior_add_up(sdf):
    pose = poses_of(turned([1, 0, 0], 5.0, [0.31, -0.1, 0.05]))
    parts = [PosePrior(**CONFIDENT), PosePrior(**UPRIGHT)]
    both = PosePrior(**CONFIDENT, **UPRIGHT)
    costs = [prior.quadratic_costs(pose, sdf)[0] for prior in (*parts, both)]
    assert costs[2] == pytest.approx(costs[0] + costs[1])
    assert both.energies(pose, sdf)[0] == pytest.approx(bounded(costs[2]))


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({}, "the prior is empty"),
        ({"centre": [0, 0, 0]}, "has centre without centre_noise"),
        ({"point": [0, 0, 0], **UPRIGHT}, "has point without centre, centre_noise"),
        ({**UPRIGHT, "along": None}, "has axis, axis_noise without along"),
        ({**UPRIGHT, "axis": [0, 0, 0]}, "axis is 0; accepted: a direction"),
        ({**UPRIGHT, "axis_noise": 5.0}, "axis_noise is 5: in degrees? accepted: 1e-09 to pi"),
        ({**UPRIGHT, "axis_noise": 1e-200}, "axis_noise is 1e-200; accepted: 1e-09 to pi"),
        ({**CONFIDENT, "centre_noise": 0.0}, "centre_noise is 0"),
        ({**CONFIDENT, "centre_noise": 1e-300}, "centre_noise is 1e-300; accepted: 1e-09 to"),
        ({**CONFIDENT, "centre_noise": 1e300}, "centre_noise is 1e+300; accepted: 1e-09 to"),
        ({**CONFIDENT, "centre": [np.nan, 0, 0]}, "centre[0] is not finite"),
        ({"weights": [1.0], **UPRIGHT}, "has weights without object_from_world, covariances"),
    ],
)
def test_an_incomplete_prior_is_an_error(fields, text):
    with pytest.raises(SettingError) as error:
        PosePrior(**fields)
    assert text in str(error.value)


@pytest.mark.parametrize(
    ("poses", "covariances", "text"),
    [
        (2.0 * np.eye(4)[None], np.eye(6), "object_from_world[0] is not a rigid transform"),
        (np.eye(4)[None], np.diag([1.0, 1, 1, 1, 1, 0]), "covariances[0] is not a covariance"),
        (np.eye(4)[None], np.triu(np.ones((6, 6))) + np.eye(6), "is not a covariance"),
        (np.eye(4)[None], 1e-320 * np.eye(6), "covariances[0, 0, 0] is 1e-320; accepted: squares"),
        (np.eye(4)[None], 1e300 * np.eye(6), "covariances[0, 0, 0] is 1e+300; accepted: squares"),
        (np.zeros((0, 4, 4)), np.eye(6), "has 0 poses; accepted: 1 to 200"),
        (np.eye(4)[None], np.ones((2, 6, 6)), "covariances has shape (2, 6, 6)"),
    ],
)
def test_poses_need_to_be_rigid_and_covariances_definite(poses, covariances, text):
    with pytest.raises(PoseError) as error:
        PosePrior(object_from_world=poses, covariances=covariances)
    assert text in str(error.value)


def test_one_covariance_and_equal_weights_are_for_all_poses():
    others, covariances = estimated(4)
    prior = PosePrior(object_from_world=others, covariances=covariances[0])
    np.testing.assert_array_equal(prior.covariances, np.repeat(covariances[:1], 4, axis=0))
    np.testing.assert_array_equal(prior.weights, 0.25)


def test_the_digest_depends_on_every_field_and_survives_a_copy():
    others, covariances = estimated(2)
    prior = PosePrior(
        **CONFIDENT,
        axis=[1.0, 2.0, 3.0],
        along=[3.0, 1.0, -1.0],
        axis_noise=0.2,
        object_from_world=others,
        covariances=covariances,
        weights=[0.1, 0.7],
    )
    copied = replace(prior)
    assert copied.digest == prior.digest
    changes = {
        "centre": [0.0, 0.0, 0.0],
        "centre_noise": 0.021,
        "point": [0.0, 0.0, 0.0],
        "axis": [1.0, 2.0, 3.1],
        "along": [3.0, 1.0, 1.0],
        "axis_noise": 0.3,
        "object_from_world": others[::-1],
        "covariances": covariances[0],
        "weights": [0.2, 0.7],
    }
    digests = {replace(prior, **{name: value}).digest for name, value in changes.items()}
    assert len(digests | {prior.digest}) == 10


def test_settings_make_a_prior_and_name_what_is_wrong():
    assert prior_from_settings("session.prior", None) is None
    prior = prior_from_settings("session.prior", CONFIDENT)
    assert prior.digest == PosePrior(**CONFIDENT).digest
    with pytest.raises(SettingError, match=r"^session.prior.center does not exist; accepted"):
        prior_from_settings("session.prior", {"center": [0, 0, 0]})
    with pytest.raises(SettingError, match=r"^session.prior: the prior has centre without"):
        prior_from_settings("session.prior", {"centre": [0, 0, 0]})
    with pytest.raises(SettingError, match=r"^session.prior is 3; accepted: a mapping"):
        prior_from_settings("session.prior", 3)


def problem_with(sdf, prior, pushes=None) -> RegistrationProblem:
    return RegistrationProblem(
        sdf=sdf,
        points=KnownPoints(known=np.array([[0.3, -0.1, 0.1], [0.3, -0.1, 0.0]])),
        initial_set=np.eye(4)[None],
        workspace=Workspace((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),
        free_resolution=0.01,
        key=StreamKey(0, 0),
        pushes=pushes,
        prior=prior,
    )


def test_a_problem_has_its_prior_in_the_digest(sdf):
    digests = [
        problem_with(sdf, prior).digest
        for prior in (None, PosePrior(**CONFIDENT), PosePrior(**UPRIGHT))
    ]
    assert len(set(digests)) == 3
    with pytest.raises(SettingError, match=r"^prior is 3; accepted: chsel.PosePrior"):
        problem_with(sdf, 3)


def test_pushes_carry_the_prior_with_the_object(sdf):
    others, covariances = estimated(2)
    prior = PosePrior(**CONFIDENT, object_from_world=others, covariances=covariances)
    pushes = Pushes(np.array([[1.0, 0, 0], [0, 1.0, 0]]), np.ones((2, 3), dtype=int), largest=0.02)
    points = KnownPoints(
        free=np.zeros((1, 3)), occupied=np.zeros((1, 3)), known=np.array([[0.3, -0.1, 0.1]])
    )
    problem = replace(problem_with(sdf, prior), points=points, pushes=pushes)
    carried = problem.carried(0.01)
    assert carried.prior is not None
    np.testing.assert_allclose(carried.prior.centre, [0.31, -0.09, 0.05])
    shift = compose(np.eye(3), np.array([0.01, 0.01, 0.0]))
    np.testing.assert_allclose(
        inverse(carried.prior.object_from_world), shift @ inverse(others), atol=1e-12
    )
    poses = Poses.of(others)
    moved = Poses.of(inverse(shift @ inverse(others)))
    np.testing.assert_allclose(
        carried.prior.energies(moved, sdf), prior.energies(poses, sdf), atol=1e-6
    )


def result(pose) -> Hypotheses:
    return Hypotheses(
        pose[None], np.zeros(1), np.zeros(1, dtype=bool), np.zeros(1, dtype=int), pose[None]
    )


def test_points_that_contradict_the_prior_are_a_warning(sdf):
    centre = np.array(CONFIDENT["centre"])
    problem = problem_with(sdf, PosePrior(**CONFIDENT, **UPRIGHT))
    best = turned([1, 0, 0], 40.0, centre + np.array([0.12, 0.0, 0.0]))
    (warning,) = check_prior(problem, result(best))
    assert warning.code == "prior"
    assert str(warning) == (
        "the points contradict the prior: the best pose is 12.0 cm and 40 degrees off it"
    )
    assert check_prior(problem, result(turned([1, 0, 0], 5.0, centre + 0.02))) == []
    assert check_prior(problem_with(sdf, None), result(best)) == []


def test_a_right_prior_is_seldom_contradicted(sdf):
    stream = np.random.default_rng(2)
    others, covariances = estimated(1)
    prior = PosePrior(object_from_world=others, covariances=covariances)
    world = inverse(others)[0]
    offsets = stream.multivariate_normal(np.zeros(6), covariances[0], size=300)
    turns = Rotation.from_rotvec(offsets[:, 3:]).as_matrix() @ world[:3, :3]
    middle = world[:3, :3] @ centre_of(sdf) + world[:3, 3] + offsets[:, :3]
    drawn = Poses.of(inverse(compose(turns, middle - turns @ centre_of(sdf))))
    contradicted = [prior.is_contradicted(drawn[n : n + 1], sdf) for n in range(300)]
    assert sum(contradicted) <= 9  # chi-squared of 6 is above 16 in 1.4 %: 4 of 300
