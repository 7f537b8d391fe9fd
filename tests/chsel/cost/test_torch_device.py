"""The relaxed cost away from the processor: on a GPU, and on a device that is only pretended."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
import trimesh
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

from chsel import CostSettings, KnownPoints, RelaxedCost, SdfGrid
from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.torch_cost import gpus
from chsel.errors import EngineError, SettingError
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import Poses
from chsel.problem.search_space import PlaneSettings, SE2Space, SE3Space
from tests.chsel.problem.torch_spaces import decode
from tests.chsel.samples import random_poses

needs_gpu = pytest.mark.skipif(gpus() == 0, reason="torch finds no GPU here")
SETTINGS = [
    CostSettings(penetration_tolerance=-0.01),
    CostSettings(
        penetration_tolerance=-0.01, lookup="nearest", outside="bounding_box", gradient="exact"
    ),
    CostSettings(penetration_tolerance=-0.01, free_term="interior", known_tolerance=0.002),
]
PRETENDED = torch.device("meta")


@pytest.fixture
def grid() -> SdfGrid:
    """Made anew, as a grid keeps its tensors on every device."""
    return SdfGrid.from_mesh(trimesh.creation.box((0.12, 0.08, 0.06)), 0.01)


@pytest.fixture(scope="module")
def points() -> KnownPoints:
    stream = np.random.default_rng(0)
    free = np.moveaxis(np.indices((20, 20, 20)), 0, -1).reshape(-1, 3) * 0.015 - 0.15
    occupied, known = stream.uniform(-0.2, 0.2, (7, 3)), stream.uniform(-0.1, 0.1, (20, 3))
    return KnownPoints(free, occupied, known, stream.uniform(-0.02, 0.02, 20))


def poses(count: int, reach: float = 0.2) -> FloatArray:
    return random_poses(np.random.default_rng(1), count, reach)


def costs_and_gradients(cost: RelaxedCost, space: Any, vectors: FloatArray) -> list[FloatArray]:
    """Costs (B,) and gradients (B, d) by torch, on the cost's device."""
    leaves = torch.tensor(vectors).to(cost.device).requires_grad_()
    values = cost(*decode(space, leaves))
    values.sum().backward()
    assert leaves.grad is not None
    assert leaves.grad.device == values.device == cost.device
    return [part.detach().cpu().numpy() for part in (values, leaves.grad)]


class OnPretendedDevice(torch.Tensor):
    """A tensor that says it is on the pretended device; its numbers are in `numbers`."""

    numbers: torch.Tensor

    @staticmethod
    def __new__(cls, numbers: torch.Tensor) -> OnPretendedDevice:
        made = torch.Tensor._make_wrapper_subclass(
            cls, numbers.shape, strides=numbers.stride(), dtype=numbers.dtype, device=PRETENDED
        )
        made.numbers = numbers
        return made

    @classmethod
    def __torch_dispatch__(cls, call: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return PretendedDevice.call(call, args, kwargs or {})


class PretendedDevice(TorchDispatchMode):
    """A device on which torch computes as on the processor, but that mixes no tensors with its.

    As on a GPU, an operation on tensors of both devices is an error, but for copies and single
    numbers. `copies` are the shapes of what went from one device to the other; `largest` is how
    many numbers the largest tensor had that an operation made there.
    """

    copies: ClassVar[list[tuple[int, ...]]] = []
    largest: ClassVar[int] = 0

    def __torch_dispatch__(self, call: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return self.call(call, args, kwargs or {})

    @classmethod
    def call(cls, call: Any, args: Any, kwargs: Any) -> Any:
        tensors = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, torch.Tensor)]
        there = [isinstance(x, OnPretendedDevice) for x in tensors]
        sizeable = [on for x, on in zip(tensors, there, strict=True) if on or x.dim() > 0]
        is_copy = call in (torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default)
        if any(sizeable) and not all(sizeable) and not is_copy:
            raise AssertionError(f"{call} mixes a tensor of the processor with one of the device")
        target = any(there)
        if kwargs.get("device") is not None:
            target = torch.device(kwargs["device"]) == PRETENDED
            kwargs = {**kwargs, "device": torch.device("cpu")}
        if tensors and is_copy and target != any(there):
            cls.copies.append(tuple(tensors[0].shape))
        args, kwargs = tree_map(
            lambda x: x.numbers if isinstance(x, OnPretendedDevice) else x, (args, kwargs)
        )
        made = call(*args, **kwargs)
        if not target:
            return made
        sizes = [x.numel() for x in tree_flatten(made)[0] if isinstance(x, torch.Tensor)]
        PretendedDevice.largest = max(PretendedDevice.largest, *sizes, 0)
        return tree_map(lambda x: OnPretendedDevice(x) if isinstance(x, torch.Tensor) else x, made)


@pytest.fixture
def pretended(monkeypatch: pytest.MonkeyPatch) -> Iterator[type[PretendedDevice]]:
    monkeypatch.setattr("chsel.cost.torch_cost.device_named", lambda name: PRETENDED)
    monkeypatch.setattr(PretendedDevice, "copies", [])
    monkeypatch.setattr(PretendedDevice, "largest", 0)
    with PretendedDevice():
        yield PretendedDevice


def test_the_pretended_device_refuses_a_tensor_of_the_processor(pretended: object) -> None:
    there = torch.ones(3).to(PRETENDED)
    assert (there + 1.0).cpu().tolist() == [2.0, 2.0, 2.0]
    for mixed in (lambda: there + torch.ones(3), lambda: there[torch.tensor([0, 1])]):
        with pytest.raises(AssertionError, match="mixes a tensor"):
            mixed()


@pytest.mark.parametrize("settings", SETTINGS)
def test_only_poses_and_costs_cross_to_another_device_and_back(
    grid: SdfGrid, points: KnownPoints, settings: CostSettings, pretended: type[PretendedDevice]
) -> None:
    here = CompiledCost(grid, points, settings, free_resolution=0.015)
    there = RelaxedCost(
        grid, points, settings, free_resolution=0.015, device="cuda", pairs_at_once=4000
    )
    size = there._poses_at_once
    assert 1 < size < 30
    there.evaluate(poses(1))
    pretended.copies.clear()
    costs = there.evaluate(poses(50))
    np.testing.assert_allclose(costs, here.evaluate(poses(50)), rtol=1e-12, atol=1e-14)
    chunks = [min(size, 50 - first) for first in range(0, 50, size)]
    assert pretended.copies == [shape for n in chunks for shape in ((n, 4, 4), (n,))]


@pytest.mark.parametrize("settings", SETTINGS)
def test_no_tensor_has_more_rows_than_pairs_at_once(
    grid: SdfGrid, settings: CostSettings, pretended: type[PretendedDevice]
) -> None:
    """With poses deep in free space, which need many nodes of the tree; a row has 13 numbers."""
    free = np.moveaxis(np.indices((30, 30, 30)), 0, -1).reshape(-1, 3) * 0.005 - 0.075
    cost = RelaxedCost(
        grid, KnownPoints(free), settings, free_resolution=0.005, device="cuda", pairs_at_once=5000
    )
    pretended.largest = 0
    costs = cost.evaluate(poses(60, reach=0.02))
    assert costs.min() > 0.0
    assert 5000 < pretended.largest <= 13 * 5000


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("plane", [False, True])
def test_gradients_stay_on_the_device(
    grid: SdfGrid,
    points: KnownPoints,
    settings: CostSettings,
    plane: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    space = SE2Space(PlaneSettings(offset=0.02), grid) if plane else SE3Space()
    vectors = space.encode(Poses.of(poses(9, reach=0.05)))
    here = RelaxedCost(grid, points, settings, free_resolution=0.015)
    expected = costs_and_gradients(here, space, vectors)
    monkeypatch.setattr("chsel.cost.torch_cost.device_named", lambda name: PRETENDED)
    with PretendedDevice():
        there = RelaxedCost(grid, points, settings, free_resolution=0.015, device="cuda")
        found = costs_and_gradients(there, space, vectors)
    assert np.abs(expected[1]).max() > 0.1
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("settings", SETTINGS)
def test_how_many_pairs_are_taken_at_once_changes_no_bit(
    grid: SdfGrid, points: KnownPoints, settings: CostSettings
) -> None:
    whole, parts = (
        RelaxedCost(grid, points, settings, free_resolution=0.015, pairs_at_once=pairs)
        for pairs in (10_000_000, 7)
    )
    transforms = poses(40)
    np.testing.assert_array_equal(whole.evaluate(transforms), parts.evaluate(transforms))


def test_poses_that_are_not_finite_cost_infinitely_much(grid: SdfGrid, points: KnownPoints) -> None:
    transforms = poses(4)
    transforms[1, 0, 3], transforms[2, 1, 1] = np.nan, np.inf
    for settings in SETTINGS:
        here = CompiledCost(grid, points, settings, free_resolution=0.015)
        costs = RelaxedCost(grid, points, settings, free_resolution=0.015).evaluate(transforms)
        assert np.isinf(costs[1:3]).all()
        np.testing.assert_allclose(costs, here.evaluate(transforms), rtol=1e-12)


def test_matrices_that_stretch_leave_no_violated_point_out(
    grid: SdfGrid, points: KnownPoints
) -> None:
    for factor in (0.2, 3.0):
        transforms = poses(20, reach=0.05)
        transforms[:, :3, :3] *= factor
        transforms[:, 0, :3] *= 1.5
        expected = []
        for transform in transforms:
            s, _ = grid.query(points.free @ transform[:3, :3].T + transform[:3, 3])
            expected.append(20.0 * np.maximum(0.0, -0.01 - s.numpy()).sum())
        cost = RelaxedCost(
            grid,
            KnownPoints(points.free),
            CostSettings(penetration_tolerance=-0.01, lookup="nearest"),
        )
        assert np.max(expected) > 0.1
        np.testing.assert_allclose(cost.evaluate(transforms), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "count", "message"),
    [
        ("cuda", 0, "device is cuda, but torch finds no GPU here; accepted: cpu"),
        ("cuda:1", 1, "device is cuda:1, but torch finds 1 GPU here; accepted: cpu, cuda, cuda:0"),
        ("gpu", 0, "device is gpu; accepted: cpu"),
        ("gpu", 2, "device is gpu; accepted: cpu, cuda, cuda:0, cuda:1"),
    ],
)
def test_a_device_that_is_not_here_is_an_error(
    grid: SdfGrid, monkeypatch: pytest.MonkeyPatch, name: str, count: int, message: str
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    with pytest.raises(EngineError) as caught:
        RelaxedCost(grid, KnownPoints(known=[[0, 0, 0]]), device=name)
    assert str(caught.value) == message


def test_poses_on_another_device_than_the_cost_are_an_error(grid: SdfGrid) -> None:
    cost = RelaxedCost(grid, KnownPoints(known=[[0, 0, 0]]))
    rotation, translation = torch.eye(3, device="meta")[None], torch.zeros((1, 3))
    with pytest.raises(EngineError, match="poses are on meta, the cost is on cpu; accepted"):
        cost(rotation, translation)


@pytest.mark.parametrize("pairs", [0, -5, float("nan")])
def test_no_pairs_at_once_is_an_error(grid: SdfGrid, pairs: int) -> None:
    with pytest.raises(SettingError, match="pairs_at_once is"):
        RelaxedCost(grid, KnownPoints(known=[[0, 0, 0]]), pairs_at_once=pairs)


@needs_gpu
@pytest.mark.parametrize("settings", SETTINGS)
def test_a_gpu_gives_the_same_bits_again(
    grid: SdfGrid, points: KnownPoints, settings: CostSettings
) -> None:
    vectors = SE3Space().encode(Poses.of(poses(20_000)))

    def run() -> list[FloatArray]:
        cost = RelaxedCost(grid, points, settings, free_resolution=0.015, device="cuda")
        return costs_and_gradients(cost, SE3Space(), vectors)

    first = run()
    torch.use_deterministic_algorithms(True)  # an operation that is not, raises
    try:
        others = [run(), run()]
    finally:
        torch.use_deterministic_algorithms(False)
    for other in others:
        for one, two in zip(first, other, strict=True):
            np.testing.assert_array_equal(one.view(np.int64), two.view(np.int64))


@needs_gpu
@pytest.mark.parametrize("settings", SETTINGS)
def test_a_gpu_agrees_with_the_processor(
    grid: SdfGrid, points: KnownPoints, settings: CostSettings
) -> None:
    here = CompiledCost(grid, points, settings, free_resolution=0.015)
    there = RelaxedCost(grid, points, settings, free_resolution=0.015, device="cuda")
    expected = here.evaluate(poses(20_000))
    np.testing.assert_allclose(there.evaluate(poses(20_000)), expected, rtol=1e-9, atol=1e-12)
    vectors = SE3Space().encode(Poses.of(poses(500, reach=0.05)))
    plain = RelaxedCost(grid, points, settings, free_resolution=0.015)
    slopes = costs_and_gradients(plain, SE3Space(), vectors)[1]
    found = costs_and_gradients(there, SE3Space(), vectors)[1]
    np.testing.assert_allclose(found, slopes, rtol=0.0, atol=1e-9 * np.abs(slopes).max())


@needs_gpu
@pytest.mark.parametrize("settings", SETTINGS)
def test_a_million_poses_fit_into_bounded_memory_of_a_gpu(
    grid: SdfGrid, points: KnownPoints, settings: CostSettings
) -> None:
    transforms = poses(1_000_000)
    cost = RelaxedCost(
        grid, points, settings, free_resolution=0.015, device="cuda", pairs_at_once=1_000_000
    )
    torch.cuda.reset_peak_memory_stats()
    costs = cost.evaluate(transforms)
    assert torch.cuda.max_memory_allocated() < 2**30
    np.testing.assert_array_equal(cost.evaluate(transforms[-1000:]), costs[-1000:])
