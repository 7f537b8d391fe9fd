"""Where torch computes: on the processor, or on a GPU."""

from __future__ import annotations

import torch

from chsel.errors import EngineError


def gpus() -> int:
    """How many GPUs torch finds here."""
    return torch.cuda.device_count() if torch.cuda.is_available() else 0


def device_named(name: str) -> torch.device:
    """The device "cpu", "cuda" (the GPU that torch uses at present) or "cuda:N".

    Raises EngineError, with what is accepted here, for any other.
    """
    count = gpus()
    accepted = ["cpu", *(["cuda"] if count else []), *(f"cuda:{n}" for n in range(count))]
    if name == "cuda" and count:
        return torch.device("cuda", torch.cuda.current_device())
    if name in accepted:
        return torch.device(name)
    found = f"{count} GPU{'s' * (count > 1)}" if count else "no GPU"
    but = f", but torch finds {found} here" if str(name).startswith("cuda") else ""
    raise EngineError(f"device is {name}{but}; accepted: {', '.join(accepted)}")
