"""Which files of the library hold kernels."""

from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]


def kernel_files(repository=REPOSITORY):
    """The files of `chsel` that import the compiler of kernels."""
    files = (repository / "chsel").rglob("*.py")
    return sorted(file for file in files if "from chsel.numerics.compiler" in file.read_text())
