"""A process that does tasks on request: one JSON object a line in, one out."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, Self

from chsel.errors import ChselError


class WorkerError(ChselError):
    """A worker cannot be started, or its process ended."""


class RefusedError(WorkerError):
    """The worker cannot do a task; its process goes on."""


class WorkerProcess:
    """A process whose first line says what it is, and that then answers requests in turn."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        """Start it; raise OSError if the command does not run, WorkerError if it says why not."""
        self._printed = tempfile.TemporaryFile()  # noqa: SIM115  (closed by close)
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._printed,
            env=dict(environment),
            text=True,
        )
        try:
            self.description = self._answer()
        except WorkerError:
            self.close()
            raise

    def ask(self, task: str, **arguments: Any) -> dict[str, Any]:
        """Have the process do a task and return its answer."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # the missing answer says more
            self._process.stdin.write(json.dumps({"task": task, **arguments}) + "\n")
            self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._printed.seek(0)
            printed = self._printed.read().decode(errors="replace")
            raise WorkerError(f"its process ended: {last_line(printed)}")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            text = " ".join(answer["error"].split())
            hint = "; on Debian, apt install libusb-1.0-0" if "libusb" in text else ""
            raise RefusedError(f"{text}{hint}")
        return answer

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()
        self._printed.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def last_line(text: str) -> str:
    """Return the last line of an error output."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("ERROR:")]
    return (errors or lines or ["no message"])[-1]
