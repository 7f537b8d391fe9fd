"""`python -m replay VERB FILE ...`: everything that is done with recordings."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import warnings
from collections.abc import Sequence
from types import ModuleType
from typing import NoReturn

from chsel.errors import ChselError
from replay.console import print_error, print_warning
from replay.startup import package_version, ready
from replay.verbs import VERBS

TRACEBACK = "--traceback"
COMPLETES = "_ARGCOMPLETE"
"""Set in the environment by a shell that asks what can stand next on the line in COMP_LINE."""


class Parser(argparse.ArgumentParser):
    """An argument parser that says in one line what is wrong."""

    def error(self, message: str) -> NoReturn:
        """Print it and exit with status 2."""
        print_error(f"{self.prog}: {message} (--help shows what is accepted)")
        sys.exit(2)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a verb; its exit status. A user's mistake is one line on stderr and status 2."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    show_traceback = TRACEBACK in words
    words = [word for word in words if word != TRACEBACK]
    warnings.showwarning = print_warning
    try:
        given = _parser(words[0] if words else "").parse_args(words)
        ready()
        status: int = _module(given.verb).run(given)
        sys.stdout.flush()
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # nobody reads the output any more, as with `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ChselError, OSError, MemoryError) as error:
        if show_traceback:
            raise
        print_error(_message(error))
        return 2
    return status


def program() -> NoReturn:
    """Run the command `chsel-replay`."""
    if COMPLETES in os.environ:
        _complete(os.environ["COMP_LINE"].split())
    sys.exit(main())


def _complete(words: Sequence[str]) -> None:
    """Answer the shell, and exit."""
    import argcomplete

    argcomplete.autocomplete(_parser(next((word for word in words if word in VERBS), "")))


def _parser(verb: str) -> Parser:
    """Return the parser of all verbs, with the arguments of one."""
    parser = Parser(prog="replay", description=__doc__)
    parser.add_argument(TRACEBACK, action="store_true", help="show where an error came from")
    version = f"chsel-replay {package_version()}"
    parser.add_argument("--version", action="version", version=version)
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name, summary in VERBS.items():
        module = _module(name) if name == verb else None
        described = module.__doc__ if module else summary
        of = verbs.add_parser(name, help=summary, description=described)
        if module:
            module.add_arguments(of)
    return parser


def _module(verb: str) -> ModuleType:
    return importlib.import_module(f"replay.verbs.{verb}")


def _message(error: Exception) -> str:
    """Return one line: what was wrong, and what is accepted."""
    if isinstance(error, MemoryError):
        return f"there is not enough memory: {error or 'an array is too large'}"
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror or error}"
    return " ".join(str(error).split("\n"))


if __name__ == "__main__":
    program()
