"""What stands in a recording for a mesh or an SDF grid that damage has destroyed."""

from __future__ import annotations

from typing import Any

from chsel.errors import RecordingError


class LostAttachment:
    """The place of an attachment that a recovered recording no longer has.

    name: of the attachment. digest: of what it held, as recorded. Whoever needs more of it than
    that gets a RecordingError, which says that it is lost.
    """

    stands_in = True  # for a mesh or a grid, where their class is asked for

    def __init__(self, name: str, digest: str) -> None:
        self.name = name
        self.digest = digest

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise self.error()

    def error(self) -> RecordingError:
        """What to raise where the attachment is needed."""
        return RecordingError(
            f"this needs the attachment {self.name} of the recording, which was lost when its file "
            "was damaged; accepted: a recording that has it"
        )


def is_lost(attachment: object) -> bool:
    """Whether a mesh or grid of a recording is lost."""
    return isinstance(attachment, LostAttachment)
