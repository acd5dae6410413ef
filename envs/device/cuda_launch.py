# numba's and the driver's own types say too little about themselves:
# mypy: disable-error-code="attr-defined,no-untyped-call"
"""The kernel's PTX, cached on disk, and its launch by CUDA's driver or in numba's simulator.

PTX is compiled without a GPU. In float64 a product and a sum are never contracted to one operation,
for which NVVM's call has a switch and numba-cuda's decorator has none.
"""

import contextlib
import ctypes
import hashlib
import json
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from types import SimpleNamespace
from typing import Any

import numpy as np
from numba import cuda, types

from ..io import replace_file
from ..numerics import kernel_cache
from ..numerics.torch_backend import torch
from .cuda_kernel import NAME, SIMULATED, KernelConstants, make_kernel, make_specification

if not SIMULATED:  # the simulator has no compiler
    from numba.cuda import dispatcher
    from numba.cuda.compiler import compile_cuda, kernel_fixup
    from numba.cuda.cudadrv.nvvm import NVVM
    from numba.cuda.np.numpy_support import from_dtype

Tensor = torch.Tensor
BLOCK = 128  # threads; 255 registers each leave a multiprocessor of an H200 two such blocks
_SIMULATED_BLOCK = 4
_Capability = tuple[int, int]  # of a GPU: (9, 0) is an H200


def get_ptx(
    constants: KernelConstants, real: type[np.floating[Any]], capability: _Capability
) -> str:
    """Get a kernel's PTX, from the disk or compiled.

    Args:
        constants: Constants of the kernel.
        real: Type of floats.
        capability: Compute capability of the GPU.
    """
    folder = kernel_cache.find_kernel_folder("envs")
    versions = version("numba-cuda"), version("numba"), NVVM().get_version()
    key = json.dumps([constants, real.__name__, capability, versions])
    path = folder / f"fused-{hashlib.sha256(key.encode()).hexdigest()[:16]}.ptx" if folder else None
    if path and (data := kernel_cache.read_trusted(path)):
        header, _, text = data.partition(b"\n")
        if header == _make_header(key, text):  # else it is not whole, or another's
            return text.decode()
    ptx = _compile_ptx(constants, real, capability)
    if path:
        text = ptx.encode()
        with contextlib.suppress(OSError), replace_file(path) as file:
            file.write(_make_header(key, text) + b"\n" + text)
    return ptx


def _make_header(key: str, text: bytes) -> bytes:
    """Make the first line of a file: the key of its compilation, and its text's hash."""
    return f"// {key} {hashlib.sha256(text).hexdigest()}".encode()


def _compile_ptx(
    constants: KernelConstants, real: type[np.floating[Any]], capability: _Capability
) -> str:
    """Compile the kernel's PTX."""
    specification = make_specification(constants, real, 1, 1)
    pointers = [types.CPointer(from_dtype(np.dtype(dtype))) for dtype, _ in specification]
    with _set_capability(capability):
        result = compile_cuda(
            make_kernel(constants, real), types.void, (types.int64, types.boolean, *pointers),
            nvvm_options={"opt": 3, "fma": real is np.float32}, cc=capability,
        )  # fmt: skip
        library = result.library
        kernel = library.get_function(result.fndesc.llvm_func_name)
        library._entry_name = kernel.name
        kernel_fixup(kernel, False)
        return str(library.get_asm_str(cc=capability)).replace(kernel.name, NAME)


@contextlib.contextmanager
def _set_capability(capability: _Capability) -> Iterator[None]:
    """Set the compute capability, which numba-cuda asks a driver for that may be missing."""

    class Device:
        compute_capability = capability

    previous, dispatcher.get_current_device = dispatcher.get_current_device, lambda: Device
    try:
        yield
    finally:
        dispatcher.get_current_device = previous


class _DriverKernel:
    """The kernel of a PTX text on a GPU; RuntimeError where that refuses it, or MemoryError."""

    def __init__(self, ptx: str, device: torch.device, driver: Any) -> None:
        self._driver, self._device = driver, device
        self._text = ptx.encode() + b"\0"  # as long as the module is there
        with torch.cuda.device(device):
            torch.empty(1, device=device)  # makes torch's context the current one
            major, minor = torch.cuda.get_device_capability(device)
            label = f"the kernel for sm_{major}{minor} on {device}"
            self._module = self._check_result(driver.cuModuleLoadData(self._text), label)
            function_result = driver.cuModuleGetFunction(self._module, NAME.encode())
            self._function = self._check_result(function_result, label)

    def __call__(self, count: int, resets: bool, arrays: Sequence[Tensor]) -> None:
        """Step `count` rows, or reset those that are asked for; arrays as in `DeviceArrays`."""
        values = (count, resets, *(array.data_ptr() for array in arrays))
        kinds = (ctypes.c_int64, ctypes.c_bool, *[ctypes.c_void_p] * len(arrays))
        shape = -(-count // BLOCK), 1, 1, BLOCK, 1, 1  # of the grid and of a block
        with torch.cuda.device(self._device):
            stream = torch.cuda.current_stream(self._device).cuda_stream
            parameters = self._function, *shape, 0, stream, (values, kinds), 0
            launched = self._driver.cuLaunchKernel(*parameters)
        self._check_result(launched, f"a step of {count} rows on {self._device}")

    def _check_result(self, result: Any, label: str) -> Any:
        """Get the driver's result besides its code, of which a failure raises."""
        code, *values = result
        if code.value != 0:
            out_of_memory = code == self._driver.CUresult.CUDA_ERROR_OUT_OF_MEMORY
            raise (MemoryError if out_of_memory else RuntimeError)(f"{label}: {code.name}")
        return values[0] if values else None


def load_kernel(
    constants: KernelConstants, real: type[np.floating[Any]], device: torch.device
) -> Any:
    """Load a kernel on a GPU, or in numba's simulator: plain Python, a thread after the other.

    Args:
        constants: Constants of the kernel.
        real: Type of floats.
        device: GPU.

    Returns:
        Function of the number of rows, whether they are reset, and `DeviceArrays`.
    """
    if not SIMULATED:
        from cuda.bindings import driver

        ptx = get_ptx(constants, real, torch.cuda.get_device_capability(device))
        return _DriverKernel(ptx, device, driver)
    kernel: Any = cuda.jit(make_kernel(constants, real))

    def simulate(count: int, resets: bool, arrays: Sequence[Tensor]) -> None:
        pointers = [SimpleNamespace(numbers=array.numpy()) for array in arrays]
        kernel[-(-count // _SIMULATED_BLOCK), _SIMULATED_BLOCK](count, resets, *pointers)

    return simulate
