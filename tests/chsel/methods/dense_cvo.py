"""CVO written out over all pairs of points, as its equations have it."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import trimesh

from chsel.methods.cvo import Kernel, Product, class_field, flow_at
from chsel.numerics.arrays import FloatArray
from chsel.numerics.pose_tuples import pose_at
from chsel.problem.points import KnownPoints
from chsel.problem.poses import apply, compose, rotation_vector
from chsel.problem.sdf_grid import SdfGrid

SIGMA, S_SIGMA, S_ELL = 0.1, 0.8, 0.1
FREE, SURFACE = np.array([0.9, 0.1]), np.array([0.1, 0.9])
C = D = 7.0
KERNEL = Kernel(0.1, 0.0064)
MESH = trimesh.creation.box([0.12, 0.08, 0.06])
SDF = SdfGrid.from_mesh(MESH, 0.01, padding=0.03)


def scene(count: int = 60) -> KnownPoints:
    """Free points and 20 contacts around the box."""
    stream = np.random.default_rng(1)
    free = stream.uniform(-0.25, 0.25, (count, 3))
    return KnownPoints(free=free, known=stream.uniform(-0.06, 0.06, (20, 3)))


def product_of(points: KnownPoints, kernel: Kernel, sdf: SdfGrid = SDF) -> Product:
    """The inner product by fields, with a surface band of a voxel."""
    band = sdf.resolution
    free = class_field(sdf, kernel, band, "free")
    surface = class_field(sdf, kernel, band, "surface")
    nothing = free.term(np.zeros((0, 3)), 1.0)
    return Product(free.term(points.free, 1.0), nothing, surface.term(points.contacts, 1.0))


def labels(free: int, surface: int) -> FloatArray:
    """Of so many free points, then surface points (N, 2)."""
    return np.concatenate([np.tile(FREE, (free, 1)), np.tile(SURFACE, (surface, 1))])


@dataclass(frozen=True, eq=False)
class DenseClouds:
    """x (N, 3) of the world with labels (N, 2), z (M, 3) of the object with labels (M, 2)."""

    x: FloatArray
    x_labels: FloatArray
    z: FloatArray
    z_labels: FloatArray
    ell: float = 0.1

    @classmethod
    def of(
        cls,
        sdf: SdfGrid,
        points: KnownPoints,
        band: float,
        *,
        ell: float = 0.1,
    ) -> DenseClouds:
        nodes = sdf.origin + np.argwhere(sdf.values > -np.inf) * sdf.resolution
        values = sdf.values.reshape(-1)
        free, surface = nodes[values > band], nodes[np.abs(values) <= band]
        x = np.concatenate([points.free, points.contacts])
        x_labels = labels(len(points.free), len(points.contacts))
        z = np.concatenate([free, surface])
        return cls(x, x_labels, z, labels(len(free), len(surface)), ell)

    def kernel(self, object_from_world: FloatArray) -> FloatArray:
        """a_ij (N, M) = k(x_i, y_j) s(l_i, m_j)."""
        moved = apply(object_from_world, self.x)
        apart = ((moved[:, None] - self.z) ** 2).sum(-1)
        labels_apart = ((self.x_labels[:, None] - self.z_labels) ** 2).sum(-1)
        a = SIGMA**2 * np.exp(-apart / (2 * self.ell**2))
        a *= S_SIGMA**2 * np.exp(-labels_apart / (2 * S_ELL**2))
        return a

    def product(self, object_from_world: FloatArray) -> float:
        """F(X)."""
        return float(self.kernel(object_from_world).sum())

    def flow(self, object_from_world: FloatArray) -> FloatArray:
        """(omega, u) (6,), not normalised, as sums over pairs in the world."""
        a, y = self.kernel(object_from_world), self.y(object_from_world)
        omega = np.einsum("nm,nmk->k", a, np.cross(self.x[:, None], y[None])) / C
        u = np.einsum("nm,nmk->k", a, y[None] - self.x[:, None]) / D
        return np.concatenate([omega, u])

    def y(self, object_from_world: FloatArray) -> FloatArray:
        """The object's cloud in the world (M, 3)."""
        return apply(np.linalg.inv(object_from_world), self.z)

    def quartic(self, object_from_world: FloatArray, xi: FloatArray) -> FloatArray:
        """B, C, D, E: F(G Exp(tau xi)) = F + B tau + C tau^2 + D tau^3 + E tau^4 + ..."""
        a, y, q = self.kernel(object_from_world), self.y(object_from_world), 0.5 / self.ell**2
        apart = self.x[:, None] - y
        first = np.cross(xi[:3], y) + xi[3:]
        second = np.cross(xi[:3], first)
        third = np.cross(xi[:3], second)
        fourth = np.cross(xi[:3], third)

        def dot(p: FloatArray, q: FloatArray) -> FloatArray:
            return (p * q).sum(-1)

        beta = -2 * q * dot(first, apart)
        gamma = -q * (dot(first, first) - dot(second, apart))
        delta = -q * (dot(third, apart) / 3 - dot(first, second))
        epsilon = -q * (dot(second, second) / 4 + dot(first, third) / 3 - dot(fourth, apart) / 12)
        return np.array(
            [
                (a * beta).sum(),
                (a * (gamma + beta**2 / 2)).sum(),
                (a * (delta + beta * gamma + beta**3 / 6)).sum(),
                (
                    a * (epsilon + beta * delta + beta**2 * gamma / 2 + gamma**2 / 2 + beta**4 / 24)
                ).sum(),
            ]
        )


def along(object_from_world: FloatArray, xi: FloatArray, tau: float) -> FloatArray:
    """G Exp(tau xi), the exponential by its series."""
    twist = np.zeros((4, 4))
    twist[:3, :3] = np.cross(np.eye(3), tau * xi[:3])
    twist[:3, 3] = tau * xi[3:]
    total, term = np.eye(4), np.eye(4)
    for n in range(1, 25):
        term = term @ twist / n
        total = total + term
    return object_from_world @ total


def nearby(count: int, seed: int, reach: float = 0.08) -> FloatArray:
    """Transforms (count, 4, 4) around the identity."""
    stream = np.random.default_rng(seed)
    turns = rotation_vector(stream.normal(0.0, 0.6, (count, 3)))
    return compose(turns, stream.uniform(-reach, reach, (count, 3)))


@numba.njit(error_model="numpy")
def flows(product, poses, out):  # type: ignore[no-untyped-def]
    """Fill out (B, 7) with F, sum x_i x h_i and sum h_i, h = R^T grad f, at poses (B, 12)."""
    for n in range(len(poses)):
        flow = flow_at(product, pose_at(poses, n), (0.0, 0.0, 0.0))
        for i in range(7):
            out[n, i] = flow[i]
