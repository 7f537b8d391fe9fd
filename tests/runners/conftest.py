"""What tests of commands need before they start."""

import warnings

import numpy as np
import pytest

import chsel
from chsel.methods import METHODS


@pytest.fixture(scope="session", autouse=True)
def compiled_kernels():
    """The kernels, compiled, so that no command says on stderr that it compiles them."""
    nodes = np.indices((9, 9, 9)) * 0.01 - 0.04
    radius = np.sqrt((nodes**2).sum(axis=0))
    gradients = np.moveaxis(nodes / np.maximum(radius, 1e-9), 0, -1)
    ball = chsel.SdfGrid(np.full(3, -0.04), 0.01, values=radius - 0.025, gradients=gradients)
    with warnings.catch_warnings(action="ignore", category=chsel.PointsWarning):  # of a poor fit
        for method in METHODS:
            chsel.register(ball, contacts=[[0.025, 0, 0]], free=[[0.1, 0, 0]], method=method)
