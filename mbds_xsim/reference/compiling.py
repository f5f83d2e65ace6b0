"""How kernels are compiled: each as a whole with all that it calls, and once.

numba optimises every function by itself, makes machine code of it, and does both again with all
that call it. Kernels are many small functions in many layers, so most of the time went into code
that nobody runs. Here a function that only kernels call stays as it was lowered until the one that
Python calls has all of them in one module. Passes for what kernels never have (closures, `with`,
array expressions, parallel loops) are left out, and operators of lanes and arrays are looked up
first: numba tries some fifteen other meanings of them before, each time one occurs.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from typing import Any

from numba import njit
from numba.core import config
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase
from numba.core.compiler_machinery import PassManager
from numba.core.typed_passes import (
    IRLegalization,
    NativeLowering,
    NoPythonBackend,
    NopythonTypeInference,
    PreLowerStripPhis,
)
from numba.core.typing.arraydecl import GetItemBuffer, SetItemBuffer
from numba.core.typing.templates import infer_global
from numba.core.untyped_passes import (
    DeadBranchPrune,
    FixupArgs,
    GenericRewrites,
    IRProcessing,
    ReconstructSSA,
    RewriteSemanticConstants,
    TranslateByteCode,
)

from mbds_xsim.reference.cache import kernel_folder

# Nothing is left to be found here by what looks for vectors in loops and expressions.
config.LOOP_VECTORIZE = config.SLP_VECTORIZE = 0

_PASSES = (
    TranslateByteCode,
    FixupArgs,
    IRProcessing,
    RewriteSemanticConstants,
    DeadBranchPrune,
    GenericRewrites,
    ReconstructSSA,
    NopythonTypeInference,
    PreLowerStripPhis,
    IRLegalization,
    NativeLowering,
    NoPythonBackend,
)


class _Entered(CompilerBase):
    """Compiles what Python calls."""

    def __init__(self, typingctx: Any, targetctx: Any, *others: Any) -> None:
        super().__init__(typingctx, targetctx, *others)
        # They look for news some 3000 times, and would import all that numba has each time.
        for context in (typingctx, targetctx):
            context.load_additional_registries = functools.partial(_take_in_news, context)

    def define_pipelines(self) -> list[PassManager]:
        manager = PassManager("kernel")
        for each in _PASSES:
            manager.add_pass(each, each._name)
        manager.finalize()
        return [manager]


def _take_in_news(context: Any) -> None:
    for registry in tuple(context._registries):
        context.install_registry(registry)


class _Called(_Entered):
    """Lowers what kernels call."""

    def define_pipelines(self) -> list[PassManager]:
        state = self.state
        state.library = _Lowered(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        return super().define_pipelines()

    def compile_extra(self, function: Callable[..., Any]) -> Any:
        made = super().compile_extra(function)
        made.library.finalize()
        # numba knows functions by what Python would call; nobody calls this.
        key = object().__sizeof__
        self.state.targetctx.insert_user_function(key, made.fndesc, [made.library])
        return made._replace(entry_point=key)


class _Lowered(JITCodeLibrary):
    """Functions that are linked into others only."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True


FIRST = {"target": "cpu"}
"""What a template of an operator says to be tried before those for machines of any kind."""


@infer_global(operator.getitem)
class _Read(GetItemBuffer):
    metadata = FIRST


@infer_global(operator.setitem)
class _Written(SetItemBuffer):
    metadata = FIRST


_OPTIONS = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}, "_nrt": False}


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a kernel that kernels call; no references are counted, as it makes no arrays."""
    options = {**_OPTIONS, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return njit(pipeline_class=_Called, **options)(function)


def entered(function: Callable[..., Any]) -> Any:
    """Compile a kernel that Python calls; what takes its arguments apart takes long to compile."""
    before = config.CACHE_DIR
    config.CACHE_DIR = before or str(kernel_folder())
    make = functools.partial(njit, pipeline_class=_Entered, no_cfunc_wrapper=True, **_OPTIONS)
    try:
        return make(cache=True)(function)
    except RuntimeError:  # no folder can be written to
        return make()(function)
    finally:
        config.CACHE_DIR = before
