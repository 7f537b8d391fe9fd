"""CVO."""

from chsel.methods.cvo.cvo import Cvo, CvoSettings

__all__ = ["Cvo", "CvoSettings"]
