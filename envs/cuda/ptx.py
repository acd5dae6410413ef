# numba's own types say too little about itself:
# mypy: disable-error-code="attr-defined,no-untyped-call"
"""The kernel as PTX, compiled without a GPU and kept on disk.

In float64 a product and a sum are never contracted to one operation: numba-cuda's decorator has no
switch for it, NVVM's call has.
"""

import contextlib
import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterator
from importlib.metadata import version
from typing import Any

import numpy as np
from numba import types
from numba.cuda import dispatcher
from numba.cuda.compiler import compile_cuda, kernel_fixup
from numba.cuda.cudadrv.nvvm import NVVM
from numba.cuda.np.numpy_support import from_dtype

from ..backend import cache
from ..backend.files import replace_file
from .kernel import NAME, KernelConstants, make_kernel, make_specification

Capability = tuple[int, int]  # of a GPU: (9, 0) is an H200


def get_ptx(
    constants: KernelConstants, real: type[np.floating[Any]], capability: Capability
) -> str:
    """The PTX of a kernel for GPUs of a compute capability, from the disk where it is."""
    folder = cache.find_kernel_folder("envs")
    versions = version("numba-cuda"), version("numba"), NVVM().get_version()
    key = json.dumps([constants, real.__name__, capability, versions])
    path = folder / f"fused-{hashlib.sha256(key.encode()).hexdigest()[:16]}.ptx" if folder else None
    if path and (data := cache.read_trusted(path)):
        header, _, text = data.partition(b"\n")
        if header == _make_header(key, text):  # else it is of another GPU, or not whole
            return text.decode()
    ptx = _compile_ptx(constants, real, capability)
    if path:
        text = ptx.encode()
        with contextlib.suppress(OSError), replace_file(path) as file:
            file.write(_make_header(key, text) + b"\n" + text)
    return ptx


def _make_header(key: str, text: bytes) -> bytes:
    """The first line of a file: what it was compiled for, and its text's hash."""
    return f"// {key} {hashlib.sha256(text).hexdigest()}".encode()


def _compile_ptx(
    constants: KernelConstants, real: type[np.floating[Any]], capability: Capability
) -> str:
    pointers = [
        types.CPointer(from_dtype(np.dtype(dtype)))
        for dtype, _ in make_specification(constants, real, 1, 1)
    ]
    with _set_capability(capability):
        result = compile_cuda(
            make_kernel(constants, real),
            types.void,
            (types.int64, types.boolean, *pointers),
            nvvm_options={"opt": 3, "fma": real is np.float32},
            cc=capability,
        )
        library = result.library
        kernel = library.get_function(result.fndesc.llvm_func_name)
        library._entry_name = kernel.name
        kernel_fixup(kernel, False)
        return str(library.get_asm_str(cc=capability)).replace(kernel.name, NAME)


@contextlib.contextmanager
def _set_capability(capability: Capability) -> Iterator[None]:
    """numba-cuda asks the driver for which GPU a device function is: there may be none here."""

    class Device:
        compute_capability = capability

    previous, dispatcher.get_current_device = dispatcher.get_current_device, lambda: Device
    try:
        yield
    finally:
        dispatcher.get_current_device = previous


def count_opcodes(ptx: str) -> Counter[str]:
    """How many of each instruction there are in a PTX text."""
    return Counter(re.findall(r"^\t(?:@!?%\w+ )?([a-z][a-z0-9]*(?:\.[a-z0-9:]+)*)[\s;]", ptx, re.M))
