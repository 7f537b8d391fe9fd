"""A wheel with machine code of kernels, by `python -m chsel.kernel_build`, is for its platform."""

from pathlib import Path

from setuptools import Distribution, setup


class KernelDistribution(Distribution):
    """The package as pyproject.toml describes it."""

    def has_ext_modules(self) -> bool:
        """Whether a wheel is for one platform and version of Python alone."""
        return any(Path(__file__).parent.glob("chsel/machine_code/*/*.nbc"))


setup(distclass=KernelDistribution)
