"""The decoding of search vectors in torch: the reference for that of the kernels."""

import torch

from chsel.problem.poses import hat
from chsel.problem.search_space import SE2Space


def decode(space, vectors):
    """Rotations (B, 3, 3) and translations (B, 3) of vectors (B, d), differentiable."""
    if not isinstance(space, SE2Space):
        return _gram_schmidt(vectors[:, :6]), vectors[:, 6:9]
    turn, rest = torch.tensor(hat(space.axis)), torch.tensor(space.resting_rotation)
    e_u, e_v, axis = (torch.tensor(part).double() for part in (space.e_u, space.e_v, space.axis))
    identity = torch.eye(3, dtype=torch.float64)
    sine, cosine = (f(vectors[:, 0])[:, None, None] for f in (torch.sin, torch.cos))
    about_axis = identity + sine * turn + (1.0 - cosine) * (axis[:, None] * axis - identity)
    return about_axis @ rest, vectors[:, 1:2] * e_u + vectors[:, 2:3] * e_v + space.offset * axis


def _gram_schmidt(rows):
    """Rotations (B, 3, 3) of raw 6-D vectors (B, 6) by Gram-Schmidt on two rows (Zhou et al.)."""
    b1 = _unit(rows[:, 0:3])
    second = rows[:, 3:6]
    b2 = _unit(second - (b1 * second).sum(dim=1, keepdim=True) * b1)
    return torch.stack([b1, b2, torch.linalg.cross(b1, b2)], dim=1)


def _unit(vectors):
    return vectors / vectors.norm(dim=1, keepdim=True).clamp_min(1e-12)
