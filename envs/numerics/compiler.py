"""The compiler of kernels: numba, with each function lowered once and each kernel emitted once.

numba by itself optimises and emits every function that a kernel calls, with everything below it,
level by level. Here a function that another one calls is a part, whose LLVM text stays as lowered.
What Python calls links the parts below it, and is optimised, emitted and cached on disk alone.
All this uses numba's internals: `jit` falls back on plain numba where they differ.
"""

import contextlib
import gc
import hashlib
import logging
import time
from collections.abc import Iterator
from inspect import iscode
from pathlib import Path
from typing import Any

from llvmlite import binding
from numba.core import typed_passes, types, untyped_passes
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import PassManager
from numba.core.dispatcher import _FunctionCompiler
from numba.core.environment import lookup_environment
from numba.core.funcdesc import default_mangler
from numba.core.registry import CPUDispatcher
from numba.core.sigutils import normalize_signature
from numba.core.targetconfig import ConfigStack
from numba.core.typing import make_concrete_template

from . import kernel_cache
from .kernel_cache import report_once

# numba's own types say too little about itself:
# mypy: disable-error-code="attr-defined,no-untyped-call,call-arg,misc,unused-ignore"

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


def _resolve_call(function: Any, context: Any, args: Any, kws: Any) -> Any:
    """Signature of an operator or a function of numba's for argument types, looked up once."""
    if kws:
        return _resolve(function, context, args, kws)
    key = function, context, args, ConfigStack.top_or_none().nrt
    if key not in _signatures:
        _signatures[key] = _resolve(function, context, args, kws)
    return _signatures[key]


@contextlib.contextmanager
def _remember_signatures() -> Iterator[None]:
    """Look up no call twice, and collect no garbage: each saves a fifth of the compiler's time."""
    enabled, resolve = gc.isenabled(), _FUNCTION.get_call_type
    gc.disable()
    _FUNCTION.get_call_type = _resolve_call
    try:
        yield
    finally:
        _FUNCTION.get_call_type = resolve
        if enabled:
            gc.enable()


_logger = logging.getLogger("sideslip.compiler")
_spent = [0.0]  # CPU-s on kernels so far, to tell a kernel's own from those it waited for


class _UnlinkedLibrary(JITCodeLibrary):
    """The LLVM text of one function, neither optimised nor linked with those that it calls."""

    def finalize(self) -> None:
        """Note what cannot be cached on disk, and nothing else."""
        self._raise_if_finalized()
        self._finalize_dynamic_globals()
        self._finalized = True

    def _get_own_module(self) -> Any:
        """The LLVM module of this function alone, for linking."""
        return super()._get_module_for_linking()

    def _get_module_for_linking(self) -> Any:
        """The module of this function and all below it, which numba's own functions link."""
        module = self._get_own_module().clone()
        for callee in _collect_callees(self)[1:]:
            if isinstance(callee, _UnlinkedLibrary):
                module.link_in(callee._get_own_module(), preserve=True)
            elif not isinstance(callee, _ExternalLibrary):
                module.link_in(callee._get_module_for_linking(), preserve=True)
        return module


class _KernelLibrary(JITCodeLibrary):
    """A kernel's own library, into which all parts are linked."""

    def _optimize_functions(self, module: Any) -> None:
        """Leave the parts as they are: they are optimised with the whole."""

    def _optimize_final_module(self) -> None:
        """Optimise once: numba's first run only prepares the counting of references."""
        passes, options = self.codegen._module_pass_manager()
        passes.run(self._final_module, options)


class _BareLibrary:
    """A part without those below it, which the kernel links itself."""

    def __init__(self, part: _UnlinkedLibrary) -> None:
        self._part, self._reload_init = part, part._reload_init

    def _ensure_finalized(self) -> None:
        self._part._ensure_finalized()

    def _get_module_for_linking(self) -> Any:
        return self._part._get_own_module()


class _ExternalLibrary:
    """A kernel that callers call as machine code: nothing is linked into them."""

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self._reload_init: set[str] = set()

    def _ensure_finalized(self) -> None:
        """Do nothing: numba asks before it links."""

    def _get_module_for_linking(self) -> Any:
        """An empty module: the machine code is found by its name."""
        return binding.parse_assembly("")


class _UnlinkedPipeline(Compiler):
    def define_pipelines(self) -> Any:
        """numba's passes, but few for what neither counts references nor holds a function."""
        if self.state.flags.nrt or any(map(iscode, self.state.func_id.code.co_consts)):
            return super().define_pipelines()
        passes = _Passes("part")
        for pass_class in _PASSES:
            passes.add_pass(pass_class, pass_class.__name__)
        passes.finalize()
        return [passes]

    def compile_extra(self, func: Any) -> Any:
        self.state.library = _UnlinkedLibrary(self.state.targetctx.codegen(), func.__qualname__)
        return super().compile_extra(func)


class _ExternalPipeline(_UnlinkedPipeline):
    def compile_extra(self, func: Any) -> Any:
        """Compile under a name that is the same in every process, unlike numba's counter."""

        def mangler(name: str, types: Any, **_: Any) -> str:
            digest = hashlib.sha256(str(tuple(types)).encode()).hexdigest()[:16]
            return str(default_mangler(f"{name}_{digest}", ()))

        self.state.targetctx = self.state.targetctx.subtarget(mangler=mangler)
        return super().compile_extra(func)


class _UnlinkedCompiler(_FunctionCompiler):
    def _customize_flags(self, flags: Any) -> Any:
        flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        return flags


class Kernel(CPUDispatcher):
    """A compiled function: a dispatcher of numba whose callees are parts.

    folder: folder of its files, or None. apart: whether callers call its machine code instead of
    taking its text in, as suits what is long and called by several kernels.
    """

    def __init__(
        self,
        py_func: Any,
        locals: Any = None,
        targetoptions: Any = None,
        pipeline_class: Any = Compiler,
        folder: Path | None = None,
        apart: bool = False,
    ) -> None:
        super().__init__(py_func, locals, targetoptions, pipeline_class)
        self.folder, self.apart = folder, apart
        self.parts: dict[Any, Any] = {}
        self._unlinked_compiler = _UnlinkedCompiler(
            py_func,
            self.targetdescr,
            self.targetoptions,
            self.locals,
            _ExternalPipeline if apart else _UnlinkedPipeline,
        )

    def _get_part(self, args: tuple[types.Type, ...]) -> Any:
        """Make the part that callers link, for arguments of these types."""
        with global_compiler_lock, self._compiling_counter:
            if args not in self.parts:
                if self.apart:
                    self.compile(args)
                    library = _ExternalLibrary(self._find_path(args))
                    part = self.overloads[args]._replace(library=library)
                else:
                    part = self._unlinked_compiler.compile(args, None)
                part = part._replace(entry_point=part.library)  # the key of its code for callers
                self.targetctx.insert_user_function(part.entry_point, part.fndesc, [part.library])
                self.parts[args] = part
            return self.parts[args]

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Get the part's signature, for numba at a call; a literal counts as any of its type."""
        pysig, args = self._compiler.fold_argument_types(args, kws)
        part = self._get_part(tuple(map(types.unliteral, args)))
        name = self.py_func.__name__
        return make_concrete_template(name, key=name, signatures=[part.signature]), pysig, args, {}

    def get_overload(self, sig: Any) -> Any:
        """Get the part's key, for numba when it lowers a call."""
        return self._get_part(tuple(normalize_signature(sig)[0])).entry_point

    def compile(self, sig: Any) -> Any:
        """Compile for arguments of these types, or load the kernel from disk."""
        args = tuple(normalize_signature(sig)[0])
        with global_compiler_lock:
            if args not in self.overloads:
                if not self._can_compile:
                    raise RuntimeError("compilation disabled")
                self.add_overload(self._load_or_build(args))
            return self.overloads[args].entry_point

    def _make_key(self, args: tuple[types.Type, ...]) -> str:
        return kernel_cache.make_key(self.py_func, args, self.targetctx.codegen())

    def _find_path(self, args: tuple[types.Type, ...]) -> Path | None:
        if self.folder is None:
            return None
        return kernel_cache.make_path(self.folder, self.py_func, self._make_key(args))

    def _load_or_build(self, args: tuple[types.Type, ...]) -> Any:
        path, key = self._find_path(args), self._make_key(args)
        if path is None:
            return self._build(args)[0]
        result = kernel_cache.load(path, key, self.py_func, args, self.targetctx)
        if result is None:
            result, environments, needs = self._build(args)
            nameless = self.apart and str(result.signature.return_type) not in kernel_cache.RETURNS
            if None not in needs and not nameless:
                names = [(kernel_path.parent.name, kernel_path.name) for kernel_path in needs]
                kernel_cache.save(path, key, result, environments, names)
        return result

    def _build(self, args: tuple[types.Type, ...]) -> tuple[Any, dict[str, Any], list[Any]]:
        """Compile and link while the user waits; returns the result of `_link_library`."""
        location = f"cached in {self.folder.parent}" if self.folder else "not cached"
        text = f"compiling kernels for this machine, 10 s to a minute ({location}) ..."
        report_once("compiling", text, logging.INFO)
        start, nested = time.process_time(), _spent[0]
        with _remember_signatures():
            part = (
                self._unlinked_compiler.compile(args, None) if self.apart else self._get_part(args)
            )
            result = _link_library(part)
        spent = time.process_time() - start
        own_time, _spent[0] = spent - (_spent[0] - nested), nested + spent
        _logger.info("compiled %s in %.1f CPU-s", self.py_func.__qualname__, own_time)
        return result


def _link_library(part: Any) -> tuple[Any, dict[str, Any], list[Path | None]]:
    """(a part with all below it, emitted; their environments; files of kernels that it calls)."""
    target = part.target_context
    library = _KernelLibrary(target.codegen(), part.library.name)
    library.enable_object_caching()
    root, *callees = _collect_callees(part.library)
    library.add_llvm_module(root._final_module.clone())  # where others find the function by name
    library._reload_init.update(root._reload_init)
    needs = [item.path for item in callees if isinstance(item, _ExternalLibrary)]
    for item in callees:
        if not isinstance(item, _ExternalLibrary):
            is_part = isinstance(item, _UnlinkedLibrary)
            library.add_linking_library(_BareLibrary(item) if is_part else item)
    target.create_cpython_wrapper(library, part.fndesc, part.environment, part.call_helper)
    entry = target.get_executable(library, part.fndesc, part.environment)
    names = kernel_cache.list_environments(library)
    environments = {n: item for n in names if (item := lookup_environment(n)) is not None}
    kernel_cache.set_environments(library, environments)
    return part._replace(library=library, entry_point=entry), environments, needs


def _collect_callees(library: Any) -> list[Any]:
    """A part and all it calls, callers first: LLVM's linker drops what nothing refers to yet."""
    visited: dict[Any, None] = {}

    def visit(node: Any) -> None:
        if isinstance(node, _UnlinkedLibrary):
            for callee in node._linking_libraries:
                if callee not in visited:
                    visit(callee)
        visited[node] = None

    visit(library)
    return list(reversed(visited))
