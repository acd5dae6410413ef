# the driver's types say too little about themselves:
# mypy: disable-error-code="no-untyped-call"
"""Launches of the kernel: by CUDA's driver on torch's current stream, or by numba's simulator."""

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import cuda

from ..backend.on_torch import torch
from .kernel import NAME, KernelConstants, make_kernel
from .text import SIMULATED

BLOCK = 128  # threads; 255 registers each leave a multiprocessor of an H200 two such blocks
_SIMULATED_BLOCK = 4

Tensor = torch.Tensor


def make_context_current(device: torch.device) -> None:
    """Make torch's context the current one."""
    torch.empty(1, device=device)


class DriverKernel:
    """The kernel of a PTX text on a GPU; driver: `cuda.bindings.driver`.

    Raises RuntimeError where the GPU refuses it, MemoryError where its memory does not suffice.
    """

    def __init__(self, ptx: str, device: torch.device, driver: Any) -> None:
        self._driver, self._device = driver, device
        self._text = ptx.encode() + b"\0"  # as long as the module is there
        with torch.cuda.device(device):
            make_context_current(device)
            major, minor = torch.cuda.get_device_capability(device)
            label = f"the kernel for sm_{major}{minor} on {device}"
            self._module = self._check_result(driver.cuModuleLoadData(self._text), label)
            function_result = driver.cuModuleGetFunction(self._module, NAME.encode())
            self._function = self._check_result(function_result, label)

    def __call__(self, count: int, resets: bool, arrays: Sequence[Tensor]) -> None:
        """Step the rows, or reset those that are asked for; arrays as in `Memory`."""
        values = (count, resets, *(array.data_ptr() for array in arrays))
        kinds = (ctypes.c_int64, ctypes.c_bool, *[ctypes.c_void_p] * len(arrays))
        grid, block = (-(-count // BLOCK), 1, 1), (BLOCK, 1, 1)
        with torch.cuda.device(self._device):
            stream = torch.cuda.current_stream(self._device).cuda_stream
            launched = self._driver.cuLaunchKernel(
                self._function, *grid, *block, 0, stream, (values, kinds), 0
            )
        self._check_result(launched, f"a step of {count} rows on {self._device}")

    def _check_result(self, result: Any, label: str) -> Any:
        """What the driver returned besides its code."""
        code, *values = result
        if code.value != 0:
            out_of_memory = code == self._driver.CUresult.CUDA_ERROR_OUT_OF_MEMORY
            raise (MemoryError if out_of_memory else RuntimeError)(f"{label}: {code.name}")
        return values[0] if values else None


class SimulatedPointer:
    """A pointer of the simulator."""

    def __init__(self, tensor: Tensor) -> None:
        self.numbers = tensor.numpy()


def load_kernel(
    constants: KernelConstants, real: type[np.floating[Any]], device: torch.device
) -> Any:
    """The kernel, on a GPU or in the simulator."""
    if SIMULATED:
        return SimulatedKernel(constants, real)
    from cuda.bindings import driver

    from .ptx import get_ptx  # the simulator has no compiler

    return DriverKernel(
        get_ptx(constants, real, torch.cuda.get_device_capability(device)), device, driver
    )


class SimulatedKernel:
    """The kernel in numba's simulator: plain Python, a thread after the other."""

    def __init__(self, constants: KernelConstants, real: type[np.floating[Any]]) -> None:
        self._kernel: Any = cuda.jit(make_kernel(constants, real))

    def __call__(self, count: int, resets: bool, arrays: Sequence[Tensor]) -> None:
        """As `DriverKernel`."""
        blocks = -(-count // _SIMULATED_BLOCK)
        self._kernel[blocks, _SIMULATED_BLOCK](count, resets, *map(SimulatedPointer, arrays))
