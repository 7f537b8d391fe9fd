"""Machine code of kernels that an installation brings, for common processors.

A folder for each target, in `machine_code` beside the folders of the package. It has the files that
the kernels' cache would have, and a list of their digests. `python -m chsel.kernel_build` makes it.
"""

from __future__ import annotations

import hashlib
import platform
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding
import numba

FOLDER = Path(__file__).parents[1] / "machine_code"
LIST = "digests.txt"
_V2 = ("cx16", "popcnt", "sahf", "sse3", "sse4.1", "sse4.2", "ssse3")
_V3 = (*_V2, "avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave")
_V4 = (*_V3, "avx512bw", "avx512cd", "avx512dq", "avx512f", "avx512vl")
TARGETS: dict[str, tuple[str, ...]] = {  # by LLVM's name: features that its code may use
    "x86-64-v4": _V4,
    "x86-64-v3": _V3,
    "x86-64": (),
}
if platform.machine().lower() in ("aarch64", "arm64"):
    TARGETS = {"generic": ()}
_config: Any = numba.core.config


def target_folder(target: str) -> Path:
    """The folder of code for one of TARGETS, these versions of Python and numba, and this system.

    Versions of Python that differ in the third number share code, as they do numba's own cache.
    """
    python = f"{sys.implementation.cache_tag}{getattr(sys, 'abiflags', '')}"
    versions = f"numba-{numba.__version__}-llvmlite-{llvmlite.__version__}"
    system = f"{platform.system()}-{platform.machine()}".lower()
    return FOLDER / f"{python}-{versions}-{system}-{target}"


def usable_targets() -> list[str]:
    """Those of TARGETS whose code this CPU can run, best first."""
    features = llvmlite.binding.get_host_cpu_features()
    return [
        target
        for target, needed in TARGETS.items()
        if all(features.get(feature, False) for feature in needed)
    ]


def packaged_code(name: str) -> bytes | None:
    """What the file of a kernel holds, or None if there is none for this CPU, or it is damaged."""
    for folder, digests in _folders():
        if name in digests:
            try:
                whole = (folder / name).read_bytes()
            except OSError:
                continue
            if _digest(whole) == digests[name]:
                return whole
    return None


def has_packaged_code() -> bool:
    """Whether there is code for this CPU and these versions."""
    return bool(_folders())


def write_list(folder: Path, files: Iterable[Path]) -> None:
    """Write the list of digests of files of code in a folder of them."""
    lines = [f"{_digest(file.read_bytes())} {file.name}\n" for file in sorted(files)]
    (folder / LIST).write_text("".join(lines))


@cache
def _folders() -> tuple[tuple[Path, dict[str, str]], ...]:
    """The folders for this CPU, best first, with digests by name; none if another CPU is named."""
    if _config.CPU_NAME or _config.CPU_FEATURES is not None or not FOLDER.is_dir():
        return ()
    found = []
    for target in usable_targets():
        folder = target_folder(target)
        if (folder / LIST).is_file():
            lines = map(str.split, (folder / LIST).read_text().splitlines())
            found.append((folder, {name: digest for digest, name in lines}))
    return tuple(found)


def _digest(whole: bytes) -> str:
    return hashlib.blake2b(whole, digest_size=32).hexdigest()
