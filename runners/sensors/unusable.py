"""The reason why a message of a log says nothing that can be used."""

from __future__ import annotations

from chsel.errors import ChselError


class UnusableMessage(ChselError):
    """A message is malformed, or of a kind that is not read; it is passed by and counted."""
