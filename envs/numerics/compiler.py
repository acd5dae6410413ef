"""The compiler of kernels: numba, with each function lowered once and each kernel emitted once.

numba by itself optimises and emits every function that a kernel calls, with everything below it,
level by level. Here a function that another one calls is a part, whose LLVM text stays as lowered.
What Python calls links the parts below it, and is optimised, emitted and cached on disk alone.
All this uses numba's internals: `jit` falls back on plain numba where they differ.

A kernel's file is a line of JSON and the machine code. Nothing is unpickled. Unlike with numba's
own cache, processes share no index, a full disk raises nothing, and callees are not stored.
"""

import contextlib
import gc
import hashlib
import json
import logging
import sys
import time
from collections.abc import Callable, Iterator
from inspect import iscode
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite
import numba
from llvmlite import binding
from numba.core import types
from numba.core.base import BaseContext
from numba.core.codegen import Codegen, JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult, compile_result
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import PassManager
from numba.core.dispatcher import _FunctionCompiler
from numba.core.environment import Environment, lookup_environment
from numba.core.funcdesc import PythonFunctionDescriptor, default_mangler
from numba.core.itanium_mangler import prepend_namespace
from numba.core.registry import CPUDispatcher
from numba.core.runtime import rtsys
from numba.core.sigutils import normalize_signature
from numba.core.targetconfig import ConfigStack
from numba.core.typing import Signature, make_concrete_template, signature

from ..io import replace_file
from .kernel_cache import logger, read_trusted, report_once

# numba's own types say too little about itself:
# mypy: disable-error-code="attr-defined,no-untyped-call,no-any-return,call-arg,override,misc"

_Types = tuple[types.Type, ...]
_Keywords = dict[str, types.Type]
_Function = Callable[..., object]
_Linked = tuple[CompileResult, dict[str, Environment], list[Path | None]]

_FUNCTION: Any = types.Function  # operators and numba's own functions
_signatures: dict[tuple[object, ...], Signature] = {}
_PASSES = {
    "TranslateByteCode", "FixupArgs", "IRProcessing", "RewriteSemanticConstants", "DeadBranchPrune",
    "GenericRewrites", "RewriteDynamicRaises", "ReconstructSSA", "NopythonTypeInference",
    "PreLowerStripPhis", "NativeLowering", "NoPythonBackend",
}  # fmt: skip
"""numba's passes that a function needs which neither counts references nor holds another one."""


@contextlib.contextmanager
def _remember_signatures() -> Iterator[None]:
    """Look up no call twice, and collect no garbage: each saves a tenth of the compiler's time."""
    enabled, resolve = gc.isenabled(), _FUNCTION.get_call_type

    def resolve_once(
        function: types.Function, context: BaseContext, args: _Types, kws: _Keywords
    ) -> Signature:
        key = function, context, args, *kws.items(), ConfigStack.top_or_none().nrt
        if key not in _signatures:
            _signatures[key] = resolve(function, context, args, kws)
        return _signatures[key]

    gc.disable()
    _FUNCTION.get_call_type = resolve_once
    try:
        yield
    finally:
        _FUNCTION.get_call_type = resolve
        if enabled:
            gc.enable()


_spent = [0.0]  # CPU-s on kernels so far, to tell a kernel's own from those it waited for


class _UnlinkedLibrary(JITCodeLibrary):
    """The LLVM text of one function, neither optimised nor linked with those that it calls."""

    def finalize(self) -> None:
        """Note what cannot be cached on disk, and nothing else."""
        self._raise_if_finalized()
        self._finalize_dynamic_globals()
        self._finalized = True

    def collect_callees(self) -> list[JITCodeLibrary]:
        """All that it calls, callers first: LLVM's linker drops what nothing refers to yet."""
        visited: dict[JITCodeLibrary, None] = {}

        def visit(library: JITCodeLibrary) -> None:
            if isinstance(library, _UnlinkedLibrary):
                for callee in library._linking_libraries:
                    if callee not in visited:
                        visit(callee)
            visited[library] = None

        visit(self)
        return list(reversed(visited))[1:]

    def link_callees(self, module: binding.ModuleRef) -> binding.ModuleRef:
        """Link all that it calls into a module."""
        for callee in self.collect_callees():
            # of a part its function alone: those below it are in the list
            kind = JITCodeLibrary if isinstance(callee, _UnlinkedLibrary) else type(callee)
            module.link_in(kind._get_module_for_linking(callee), preserve=True)
        return module

    def _get_module_for_linking(self) -> binding.ModuleRef:
        """The module of this function and all below it, which numba's own functions link."""
        return self.link_callees(super()._get_module_for_linking().clone())


class _KernelLibrary(JITCodeLibrary):
    """A kernel's own library, into which all parts are linked."""

    def _optimize_functions(self, module: binding.ModuleRef) -> None:
        """Leave the parts as they are: they are optimised with the whole."""

    def _optimize_final_module(self) -> None:
        """Optimise once: numba's first run only prepares the counting of references."""
        passes, options = self.codegen._module_pass_manager()
        passes.run(self._final_module, options)


class _ExternalLibrary:
    """A kernel that callers call as machine code: nothing is linked into them."""

    _reload_init = frozenset[str]()  # numba reads it

    def __init__(self, path: Path | None) -> None:
        self.path = path

    def _ensure_finalized(self) -> None:
        """Do nothing: numba asks before it links."""

    def _get_module_for_linking(self) -> binding.ModuleRef:
        """An empty module: the machine code is found by its name."""
        return binding.parse_assembly("")


class _UnlinkedPipeline(Compiler):
    def define_pipelines(self) -> list[PassManager]:
        """numba's passes, but few for what neither counts references nor holds a function."""
        (pipeline,) = super().define_pipelines()
        if not (self.state.flags.nrt or any(map(iscode, self.state.func_id.code.co_consts))):
            pipeline.passes = [item for item in pipeline.passes if item[0].__name__ in _PASSES]
        return [pipeline]

    def compile_extra(self, func: _Function) -> CompileResult:
        self.state.library = _UnlinkedLibrary(self.state.targetctx.codegen(), func.__qualname__)
        return super().compile_extra(func)


class _ExternalPipeline(_UnlinkedPipeline):
    def compile_extra(self, func: _Function) -> CompileResult:
        """Compile under a name that is the same in every process, unlike numba's counter."""

        def mangler(name: str, types: _Types, **_: object) -> str:
            digest = hashlib.sha256(str(tuple(types)).encode()).hexdigest()[:16]
            return str(default_mangler(f"{name}_{digest}", ()))

        self.state.targetctx = self.state.targetctx.subtarget(mangler=mangler)
        return super().compile_extra(func)


class _UnlinkedCompiler(_FunctionCompiler):
    def _customize_flags(self, flags: Any) -> Any:
        flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        return flags


class _Kernel(CPUDispatcher):
    """A compiled function: a dispatcher of numba whose callees are parts."""

    def __init__(
        self, py_func: _Function, locals: _Keywords | None = None,  # where numba unpickles
        targetoptions: dict[str, object] | None = None, folder: Path | None = None,
        apart: bool = False,
    ) -> None:  # fmt: skip
        super().__init__(py_func, locals, targetoptions)
        self.folder, self.apart = folder, apart
        self.parts: dict[_Types, CompileResult] = {}
        pipeline = _ExternalPipeline if apart else _UnlinkedPipeline
        self._unlinked_compiler = _UnlinkedCompiler(
            py_func, self.targetdescr, self.targetoptions, self.locals, pipeline
        )

    def _get_part(self, args: _Types) -> CompileResult:
        """Make the part that callers link, for arguments of these types."""
        with global_compiler_lock, self._compiling_counter:
            if args not in self.parts:
                if self.apart:
                    self.compile(args)
                    library = _ExternalLibrary(self._find_file(args)[0])
                    part = self.overloads[args]._replace(library=library)
                else:
                    part = self._unlinked_compiler.compile(args, None)
                part = part._replace(entry_point=part.library)  # the key of its code for callers
                self.targetctx.insert_user_function(part.entry_point, part.fndesc, [part.library])
                self.parts[args] = part
            return self.parts[args]

    def get_call_template(self, args: _Types, kws: _Keywords) -> tuple[object, ...]:
        """Get the part's signature, for numba at a call; a literal counts as any of its type."""
        pysig, args = self._compiler.fold_argument_types(args, kws)
        part = self._get_part(tuple(map(types.unliteral, args)))
        name = self.py_func.__name__
        return make_concrete_template(name, key=name, signatures=[part.signature]), pysig, args, {}

    def get_overload(self, sig: Signature | _Types) -> object:
        """Get the part's key, for numba when it lowers a call."""
        return self._get_part(tuple(normalize_signature(sig)[0])).entry_point

    def compile(self, sig: Signature | _Types) -> Callable[..., Any]:
        """Compile for arguments of some types, or load the kernel from disk."""
        args = tuple(normalize_signature(sig)[0])
        with global_compiler_lock:
            if args not in self.overloads:
                if not self._can_compile:
                    raise RuntimeError("compilation disabled")
                self.add_overload(self._load_or_build(args))
            return self.overloads[args].entry_point

    def _find_file(self, args: _Types) -> tuple[Path | None, str]:
        """Path of a kernel's file, and its key: function, argument types, versions and machine."""
        function, magic = self.py_func, self.targetctx.codegen().magic_tuple()
        versions = numba.__version__, llvmlite.__version__, sys.version, magic
        key = repr((function.__module__, function.__qualname__, str(args), versions))
        if self.folder is None:
            return None, key
        name = f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}"
        return self.folder / f"{name}-{hashlib.sha256(key.encode()).hexdigest()[:16]}.kernel", key

    def _load_or_build(self, args: _Types) -> CompileResult:
        path, key = self._find_file(args)
        if path is None:
            return self._build(args)[0]
        result = _load(path, key, self.py_func, args, self.targetctx)
        if result is None:
            result, _, needs = linked = self._build(args)
            nameless = self.apart and str(result.signature.return_type) not in _RETURNS
            if None not in needs and not nameless:
                _save(path, key, linked)
        return result

    def _build(self, args: _Types) -> _Linked:
        """Compile and link while the user waits; returns the result of `_link_library`."""
        location = f"cached in {self.folder.parent}" if self.folder else "not cached"
        text = f"compiling kernels for this machine, 10 s to a minute ({location}) ..."
        report_once("compiling", text, logging.INFO)
        start, nested = time.process_time(), _spent[0]
        with _remember_signatures():
            compiler = self._unlinked_compiler
            part = compiler.compile(args, None) if self.apart else self._get_part(args)
            result = _link_library(part)
        spent = time.process_time() - start
        own_time, _spent[0] = spent - (_spent[0] - nested), nested + spent
        logger.info("compiled %s in %.1f CPU-s", self.py_func.__qualname__, own_time)
        return result


def make_kernel(
    function: _Function, folder: Path | None, apart: bool, options: dict[str, bool]
) -> _Kernel:
    """Make the kernel of a function, in IEEE arithmetic and the order written.

    Args:
        function: Python function in numba's subset.
        folder: Folder of the kernel's files, or None.
        apart: Whether callers call its machine code instead of taking its text in, as suits what is
            long and called by several kernels.
        options: Options of numba's compiler beside ours.
    """
    all_options: dict[str, object] = {"nopython": True, "boundscheck": None}
    all_options |= {"error_model": "numpy", "fastmath": False, "forceinline": False} | options
    return _Kernel(function, None, all_options, folder, apart)


def _link_library(part: CompileResult) -> _Linked:
    """(a part with all below it, emitted; their environments; files of kernels that it calls)."""
    target = part.target_context
    library = _KernelLibrary(target.codegen(), part.library.name)
    library.enable_object_caching()
    # the function's own module, not that for linking: others find its code by the name
    library.add_llvm_module(part.library.link_callees(part.library._final_module.clone()))
    callees = part.library.collect_callees()
    needs = [callee.path for callee in callees if isinstance(callee, _ExternalLibrary)]
    target.create_cpython_wrapper(library, part.fndesc, part.environment, part.call_helper)
    entry = target.get_executable(library, part.fndesc, part.environment)
    names = _list_environments(library)
    environments = {n: item for n in names if (item := lookup_environment(n)) is not None}
    for name, environment in environments.items():
        library.codegen.set_env(name, environment)
    return part._replace(library=library, entry_point=entry), environments, needs


_RETURNS = {str(kind): kind for kind in (types.none, types.float64, types.int64, types.boolean)}
"""Return types of functions that callers find by name."""

_DIGEST = hashlib.sha256().digest_size
_ENVIRONMENT = Environment({})  # of all kernels from files: those whose own are empty
_libraries: dict[str, tuple["_Header", JITCodeLibrary]] = {}  # in this process's memory, by file


class _Header(NamedTuple):
    """First line of a kernel's file."""

    kernel: str  # the kernel's key
    symbol: str  # the function's name in the machine code
    returns: str  # key of _RETURNS
    environments: list[str]  # globals that point to environments, the function's own first
    needs: list[tuple[str, str]]  # folder and file of each kernel whose machine code it calls


def _save(path: Path, key: str, linked: _Linked) -> None:
    """Save a kernel; one that cannot be written is compiled again next time."""
    result, environments, needed_paths = linked
    library, descriptor = result.library, result.fndesc
    needs = [(need.parent.name, need.name) for need in needed_paths if need]
    constants = any(environment.consts for environment in environments.values())
    if constants or library.has_dynamic_globals:
        return  # addresses and objects of this process
    own_name, returns = descriptor.env_name, str(result.signature.return_type)
    names = [own_name, *(name for name in _list_environments(library) if name != own_name)]
    header = _Header(key, descriptor.mangled_name, returns, names, needs)
    data = json.dumps(header).encode() + b"\n" + library._get_compiled_object()
    _libraries[str(path)] = header, library
    with contextlib.suppress(OSError), replace_file(path, mode=0o600) as file:
        file.write(hashlib.sha256(data).digest() + data)


def _load(
    path: Path, key: str, function: _Function, args: _Types, target: BaseContext
) -> CompileResult | None:
    """Load a kernel from its file; None where there is none, or a damaged or foreign one."""
    rtsys.initialize(target)  # what arrays need, without all that a compiler needs
    linked = _load_library(path, target.codegen(), key)
    if linked is None:
        return None
    header, library = linked
    returns = _RETURNS.get(header.returns, types.undefined)
    names = function.__module__, function.__qualname__, function.__qualname__
    parameters = function.__code__.co_varnames[: len(args)]
    mangler, environment = lambda *_, **__: header.symbol, header.environments[0]
    # native, names, no text, no types but the result's, positional parameters alone
    descriptor = PythonFunctionDescriptor(
        True, *names, "", None, returns, None, parameters, (), mangler, args, env_name=environment
    )
    return compile_result(
        typing_context=target.typing_context, target_context=target, fndesc=descriptor,
        entry_point=target.get_executable(library, descriptor, _ENVIRONMENT), library=library,
        signature=signature(returns, *args), environment=_ENVIRONMENT, objectmode=False, lifted=(),
        reload_init=[],
    )  # fmt: skip


def _load_library(
    path: Path, codegen: Codegen, key: str | None = None
) -> tuple[_Header, JITCodeLibrary] | None:
    """(header, library) of a file and of the kernels it needs, in this process's memory."""
    if str(path) in _libraries:
        return _libraries[str(path)]
    data = read_trusted(path)
    if data is None or hashlib.sha256(data[_DIGEST:]).digest() != data[:_DIGEST]:
        return None
    header_line, _, code = data[_DIGEST:].partition(b"\n")
    try:
        header = _Header(*json.loads(header_line))
        if key not in (None, header.kernel):
            raise ValueError("it is another kernel's")
        for folder, name in header.needs:
            if _load_library(path.parents[1] / Path(folder).name / name, codegen) is None:
                return None
    except (ValueError, TypeError, RecursionError) as error:
        report_once("kernel", f"{path} is no cached kernel, which is compiled anew: {error}"[:500])
        return None
    library = codegen.create_library(header.symbol)
    library.enable_object_caching()
    library._set_compiled_object(code)  # only its entry is called: its LLVM text is not needed
    library._finalize_final_module()
    codegen._engine._defined_symbols.add(prepend_namespace(header.symbol, ns="cpython"))
    for name in header.environments:
        codegen.set_env(name, _ENVIRONMENT)
    return _libraries.setdefault(str(path), (header, library))


def _list_environments(library: JITCodeLibrary) -> list[str]:
    """List the names of the globals by which a library's code refers to environments."""
    names = [variable.name for variable in library._final_module.global_variables]
    return [name for name in names if name.startswith("_ZN08NumbaEnv")]
