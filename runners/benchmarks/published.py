"""The published package `chsel`: its virtual environment, and a process that registers with it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any

from chsel.errors import ChselError

PUBLISHED = "0.2.1"
_WORKER = Path(__file__).with_name("published_worker.py")
_LAST_LINES = 4000


class BenchmarkError(ChselError):
    """The published package cannot be installed, started or run."""


class RefusedError(BenchmarkError):
    """The package cannot do what it was asked for; its process goes on."""


@dataclass(frozen=True)
class PackageConfig:
    """Where the published package is.

    skip: measure this library alone. python: an interpreter that has it. directory: else, where
    its virtual environment is, or is made. pip: more arguments for pip. equation: the problems to
    register with the paper's own free term, too, which takes half a minute each time.
    """

    skip: bool = False
    python: str | None = None
    directory: str = "~/.cache/chsel/published"
    pip: tuple[str, ...] = ()
    equation: tuple[str, ...] = ()


class PublishedPackage:
    """A process that registers with the package, one request at a time."""

    def __init__(self, python: Path) -> None:
        """Raises BenchmarkError if `python` is no interpreter that has the package."""
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
        self._printed = tempfile.TemporaryFile()  # noqa: SIM115  (closed by close)
        try:
            self._process = subprocess.Popen(
                [str(python), "-I", str(_WORKER)],  # -I: no chsel but the installed one
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._printed,
                env=environment,
                text=True,
            )
        except OSError as error:
            self._printed.close()
            raise BenchmarkError(
                f"package.python {python} does not run ({error.strerror}); {_accepted()}"
            ) from None
        try:
            self._answer()
            self.versions = self.ask("describe")
        except BenchmarkError as error:
            self.close()
            raise BenchmarkError(
                f"{python} cannot use the published package: {error}; {_accepted()}"
            ) from None
        if self.versions["chsel"] != PUBLISHED:
            self.close()
            raise BenchmarkError(f"{python} has chsel {self.versions['chsel']}; {_accepted()}")

    def ask(self, task: str, **arguments: Any) -> dict[str, Any]:
        """Have the process do a task (a method of the worker's) and return its answer."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # the missing answer tells more
            self._process.stdin.write(json.dumps({"task": task, **arguments}) + "\n")
            self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._printed.seek(0)
            printed = self._printed.read().decode(errors="replace")
            raise BenchmarkError(f"its process ended: {_last_line(printed)}")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            text = " ".join(answer["error"].split())
            hint = "; on Debian, apt install libusb-1.0-0" if "libusb" in text else ""
            raise RefusedError(f"{text}{hint}")
        return answer

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        self._process.stdout.close()
        self._process.kill()
        self._process.wait()
        self._printed.close()

    def __enter__(self) -> PublishedPackage:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


def interpreter(config: PackageConfig, say: Callable[[str], None]) -> Path:
    """The interpreter that has the package; its environment is made first if there is none."""
    if config.python is not None:
        return Path(config.python).expanduser()
    directory = Path(config.directory).expanduser()
    finished = directory / f"chsel-{PUBLISHED}"
    python = directory / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if not finished.exists():
        make_environment(directory, python, config.pip, say)
        finished.touch()
    return python


def make_environment(
    directory: Path, python: Path, pip: tuple[str, ...], say: Callable[[str], None]
) -> None:
    """A virtual environment with the package, and torch in the version and build of ours."""
    torch = f"torch=={version('torch')}"
    say(f"making an environment for chsel {PUBLISHED} in {directory}, once: some minutes")
    _run("venv", [sys.executable, "-m", "venv", str(directory)])
    install = [str(python), "-m", "pip", "install", "--quiet", *pip]
    say(f"installing {torch}")
    _run("pip", [*install, torch])
    say(f"installing chsel=={PUBLISHED}")
    _run("pip", [*install, torch, f"chsel=={PUBLISHED}"])


def _run(what: str, command: list[str]) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except OSError as error:
        raise BenchmarkError(f"{what} does not run: {error}") from None
    if done.returncode:
        raise BenchmarkError(
            f"{what} failed: {_last_line(done.stderr or done.stdout)}; accepted: "
            "package.python=PATH of an interpreter that has the package, package.pip=[OPTION,...] "
            "for pip, or package.skip=true"
        )


def _last_line(text: str) -> str:
    """What an error output says, in one line."""
    lines = [line.strip() for line in text[-_LAST_LINES:].splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("ERROR:")]
    return (errors or lines or ["no message"])[-1]


def _accepted() -> str:
    return f"accepted: an interpreter that has chsel=={PUBLISHED}, or package.skip=true"
