# the driver's types say too little about themselves:
# mypy: disable-error-code="no-untyped-call"
"""Launches of the kernel: by CUDA's driver on torch's current stream, or by numba's simulator."""

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import cuda

from ..backend.on_torch import torch
from .kernel import NAME, How, kernel_of
from .text import SIMULATED

BLOCK = 128  # threads; 255 registers each leave a multiprocessor of an H200 two such blocks
_SIMULATED_BLOCK = 4

Tensor = torch.Tensor


def ready(device: torch.device) -> None:
    """Make torch's context the current one."""
    torch.empty(1, device=device)


class Loaded:
    """The kernel of a PTX text on a GPU; driver: `cuda.bindings.driver`.

    Raises RuntimeError where the GPU refuses it, MemoryError where its memory does not suffice.
    """

    def __init__(self, ptx: str, device: torch.device, driver: Any) -> None:
        self._driver, self._device = driver, device
        self._text = ptx.encode() + b"\0"  # as long as the module is there
        with torch.cuda.device(device):
            ready(device)
            major, minor = torch.cuda.get_device_capability(device)
            what = f"the kernel for sm_{major}{minor} on {device}"
            self._module = self._checked(driver.cuModuleLoadData(self._text), what)
            found = driver.cuModuleGetFunction(self._module, NAME.encode())
            self._function = self._checked(found, what)

    def __call__(self, count: int, resets: bool, arrays: Sequence[Tensor]) -> None:
        """Step the rows, or reset those that are asked for; arrays as in `Memory`."""
        values = (count, resets, *(each.data_ptr() for each in arrays))
        kinds = (ctypes.c_int64, ctypes.c_bool, *[ctypes.c_void_p] * len(arrays))
        grid, block = (-(-count // BLOCK), 1, 1), (BLOCK, 1, 1)
        with torch.cuda.device(self._device):
            stream = torch.cuda.current_stream(self._device).cuda_stream
            launched = self._driver.cuLaunchKernel(
                self._function, *grid, *block, 0, stream, (values, kinds), 0
            )
        self._checked(launched, f"a step of {count} rows on {self._device}")

    def _checked(self, result: Any, what: str) -> Any:
        """What the driver returned besides its code."""
        code, *rest = result
        if code.value != 0:
            out_of_memory = code == self._driver.CUresult.CUDA_ERROR_OUT_OF_MEMORY
            raise (MemoryError if out_of_memory else RuntimeError)(f"{what}: {code.name}")
        return rest[0] if rest else None


class Held:
    """A pointer of the simulator."""

    def __init__(self, tensor: Tensor) -> None:
        self.numbers = tensor.numpy()


def kernel_on(how: How, real: type[np.floating[Any]], device: torch.device) -> Any:
    """The kernel, on a GPU or in the simulator."""
    if SIMULATED:
        return Simulated(how, real)
    from cuda.bindings import driver

    from .ptx import ptx_of  # the simulator has no compiler

    return Loaded(ptx_of(how, real, torch.cuda.get_device_capability(device)), device, driver)


class Simulated:
    """The kernel in numba's simulator: plain Python, a thread after the other."""

    def __init__(self, how: How, real: type[np.floating[Any]]) -> None:
        self._kernel: Any = cuda.jit(kernel_of(how, real))

    def __call__(self, count: int, resets: bool, arrays: Sequence[Tensor]) -> None:
        """As `Loaded`."""
        blocks = -(-count // _SIMULATED_BLOCK)
        self._kernel[blocks, _SIMULATED_BLOCK](count, resets, *map(Held, arrays))
