"""Code of functions that kernels alone call: part of theirs, and never run on its own."""

from __future__ import annotations

from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler


class CompilerToLink(Compiler):
    """Numba's compiler, but what it makes becomes machine code only as a part of what calls it.

    Each function is optimised alone before, as numba does: LLVM makes vector code of a small
    function that it does not see inside of a large one, and look-ups of the SDF take half as long.
    """

    def define_pipelines(self) -> Any:
        """The usual passes, into code of this kind."""
        state = self.state
        if state.library is None:
            state.library = _CodeToLink(state.targetctx.codegen(), state.func_id.func_qualname)
        return super().define_pipelines()


class _CodeToLink(JITCodeLibrary):
    """LLVM's code for one function and all that it calls, without machine code."""

    @property
    def codegen(self) -> _CodeToLink:
        """What sets the environment of code that can run: nothing to set."""
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """Do nothing."""

    def get_pointer_to_function(self, name: str) -> int:
        """None, as zero."""
        self._ensure_finalized()
        return 0

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True
