"""Models of our own, as code, of six objects of the YCB Object and Model Set."""

from __future__ import annotations

from collections.abc import Callable

import trimesh

from runners.objects.models import clamp, cracker_box, drill, hammer, mustard, spam_can

MODELS: dict[str, Callable[[], trimesh.Trimesh]] = {
    "drill": drill.build,
    "mustard": mustard.build,
    "hammer": hammer.build,
    "cracker_box": cracker_box.build,
    "spam_can": spam_can.build,
    "clamp": clamp.build,
}
"""Each object's builder: unscaled, metres, in the frame of its YCB mesh."""
