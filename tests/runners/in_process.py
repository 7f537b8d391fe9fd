"""Commands run in this process, which spares them the imports."""

import io
import sys
import warnings
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass

import pytest
from hydra._internal.hydra import Hydra

from chsel.session.recording import one_line
from runners.evaluation import tasks


@dataclass(frozen=True)
class Done:
    """What a command left behind."""

    returncode: int
    stdout: str
    stderr: str


def run(program, *arguments, columns=160):
    """Run a command as a shell would, on a terminal of so many columns.

    Hydra would compose its configuration twice, first to see whether it has a hydra.mode.
    """
    out = io.StringIO()
    errors = io.StringIO()
    status = 0
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(errors):
        patch.setattr(sys, "argv", ["program", *arguments])
        patch.setattr(Hydra, "get_mode", lambda *_, **__: None)
        patch.setenv("COLUMNS", str(columns))
        patch.setenv("HYDRA_FULL_ERROR", "0")
        patch.setattr(warnings, "showwarning", warnings.showwarning)
        try:
            program()
        except SystemExit as end:
            status = int(end.code or 0)
    return Done(status, out.getvalue(), stderr=errors.getvalue())


def do_task(plan, task):
    """Do a task of an evaluation in this process; the reason why it failed, "" if it did not."""
    try:
        tasks.do_task(plan, task)
    except Exception as error:
        return one_line(error)
    return ""
