"""Compilation of kernels: each as a whole with everything that it calls, and only once.

numba optimises every function by itself, turns it into machine code, and does both again for each
function that calls it. Kernels are many small functions in many layers, so most of that time would
go into code that never runs. Here a function that only kernels call stays in lowered form until the
function that Python calls has all of them in one module. Passes for features that kernels never use
(closures, `with`, array expressions, parallel loops) are left out. Operators of lanes and arrays
are looked up first: numba would try some fifteen other meanings before, at each use of one.
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

# The passes that vectorise loops and expressions would find nothing to do here.
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
    """Compiler of functions that Python calls."""

    def __init__(self, typingctx: Any, targetctx: Any, *others: Any) -> None:
        super().__init__(typingctx, targetctx, *others)
        # They look for new registries some 3000 times, and would import all of numba's each time.
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
    """Compiler of functions that only kernels call: it stops after lowering."""

    def define_pipelines(self) -> list[PassManager]:
        state = self.state
        state.library = _Lowered(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        return super().define_pipelines()

    def compile_extra(self, function: Callable[..., Any]) -> Any:
        result = super().compile_extra(function)
        result.library.finalize()
        # numba identifies functions by an entry point for Python; this one is never called.
        key = object().__sizeof__
        self.state.targetctx.insert_user_function(key, result.fndesc, [result.library])
        return result._replace(entry_point=key)


class _Lowered(JITCodeLibrary):
    """Library of functions that are only linked into others."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True


FIRST = {"target": "cpu"}
"""Metadata of an operator's template that make numba try it before templates for all targets."""


@infer_global(operator.getitem)
class _Read(GetItemBuffer):
    metadata = FIRST


@infer_global(operator.setitem)
class _Written(SetItemBuffer):
    metadata = FIRST


_OPTIONS = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}, "_nrt": False}


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a kernel that kernels call, without reference counts, as it makes no arrays."""
    options = {**_OPTIONS, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return njit(pipeline_class=_Called, **options)(function)


def entered(function: Callable[..., Any]) -> Any:
    """Compile a kernel that Python calls; the code that unpacks arguments is slow to compile."""
    before = config.CACHE_DIR
    config.CACHE_DIR = before or str(kernel_folder())
    make = functools.partial(njit, pipeline_class=_Entered, no_cfunc_wrapper=True, **_OPTIONS)
    try:
        return make(cache=True)(function)
    except RuntimeError:  # there is no writable folder
        return make()(function)
    finally:
        config.CACHE_DIR = before
