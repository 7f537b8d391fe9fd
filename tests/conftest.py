"""What tests share: optional data, threads, signals, and the order of files."""

import os
import signal
from pathlib import Path

import pytest
import torch
from hypothesis import settings

REPOSITORY = Path(__file__).resolve().parents[1]
LONGEST = (  # minutes each; files that start first end before others are done
    "tests/runners/sessions/test_simulated.py",
    "tests/runners/test_evaluate.py",
    "tests/runners/test_benchmark.py",
    "tests/runners/test_steering.py",
    "tests/runners/sessions/test_fitted.py",
)
settings.register_profile("random", deadline=None)  # --hypothesis-profile=random: other examples
settings.register_profile("fixed", deadline=None, derandomize=True)
settings.load_profile("fixed")
torch.set_num_threads(1)  # two threads on two busy cores are many times slower


def _optional_data(part):
    """The folder `part` of the directory CHSEL_DATA, by default `shared` beside the checkout."""
    directory = Path(os.environ.get("CHSEL_DATA", REPOSITORY.parent / "shared")) / part
    if not directory.is_dir():
        pytest.skip(f"optional data directory is missing: no folder {part}/ (set CHSEL_DATA)")
    return directory


def pytest_collection_modifyitems(items):
    """Take the longest files first, for `-n 2 --dist loadfile --no-loadscope-reorder`."""
    items.sort(key=lambda item: not item.nodeid.startswith(LONGEST))


@pytest.fixture
def interruptible():
    """Child processes can be sent SIGINT, also where a shell has started the tests ignoring it."""
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, previous)


@pytest.fixture(params=[1, 2, 3])
def threads(request):
    """How many threads kernels take, in turn."""
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def ycb_directory():
    """Real scans, laid out as the official archives: OBJECT/google_16k/nontextured.ply."""
    return _optional_data("ycb")


@pytest.fixture(scope="session")
def real_directory():
    """Real touch measurements with their meshes."""
    return _optional_data("real")
