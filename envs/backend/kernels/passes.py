# numba's own types say too little about itself:
# mypy: disable-error-code="attr-defined,no-untyped-call,call-arg,misc,unused-ignore"
"""numba's front end without what it does for nothing: its passes, and what it looks up again."""

import contextlib
import gc
from collections.abc import Iterator
from typing import Any

from numba.core import typed_passes, types, untyped_passes
from numba.core.compiler_machinery import PassManager
from numba.core.targetconfig import ConfigStack

_FUNCTION: Any = types.Function  # operators and numba's own functions
_resolve = _FUNCTION.get_call_type
_signatures: dict[Any, Any] = {}
_UNTYPED = (
    "TranslateByteCode FixupArgs IRProcessing RewriteSemanticConstants DeadBranchPrune "
    "GenericRewrites RewriteDynamicRaises ReconstructSSA"
)
_TYPED = "NopythonTypeInference PreLowerStripPhis NativeLowering NoPythonBackend"
_PASSES = [getattr(untyped_passes, name) for name in _UNTYPED.split()]
_PASSES += [getattr(typed_passes, name) for name in _TYPED.split()]


class _Passes(PassManager):
    """Passes without numba's report of each, for which it writes out all types."""

    def _runPass(self, index: int, step: Any, state: Any) -> None:
        step.analysis = self._analysis
        step.run_pass(state)


def lean_passes() -> PassManager:
    """Those that a function needs that neither counts references nor holds another one."""
    passes = _Passes("part")
    for pass_class in _PASSES:
        passes.add_pass(pass_class, pass_class.__name__)
    passes.finalize()
    return passes


def _resolved(function: Any, context: Any, args: Any, kws: Any) -> Any:
    """What numba finds for an operator or a function of its own, by the types it is called with."""
    if kws:
        return _resolve(function, context, args, kws)
    key = function, context, args, ConfigStack.top_or_none().nrt
    if key not in _signatures:
        _signatures[key] = _resolve(function, context, args, kws)
    return _signatures[key]


@contextlib.contextmanager
def quickly() -> Iterator[None]:
    """Nothing is looked up twice, and no cycles are sought among a compiler's millions of objects:
    a fifth of its time each."""
    enabled, resolve = gc.isenabled(), _FUNCTION.get_call_type
    gc.disable()
    _FUNCTION.get_call_type = _resolved
    try:
        yield
    finally:
        _FUNCTION.get_call_type = resolve
        if enabled:
            gc.enable()
