"""The commands: `python -m runners.NAME`, or `chsel-NAME` where they are installed."""

import replay  # noqa: F401  before all other imports: `chsel` must be this project's
