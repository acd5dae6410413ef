# numba's and the driver's own types say too little about themselves:
# mypy: disable-error-code="attr-defined,no-untyped-call"
"""`CudaVectorEnv`: many cars in one CUDA kernel a step, with state and resets on the device.

The kernel's PTX is compiled without a GPU, cached on disk, and launched by CUDA's driver or in
numba's simulator. In float64 a product and a sum are never contracted to one operation, for which
NVVM's call has a switch and numba-cuda's decorator has none.
"""

import contextlib
import ctypes
import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from numba import cuda, types

from ..engine.batch import IntArray
from ..engine.layout import Z
from ..io import replace_file
from ..numerics import kernel_cache
from ..numerics.torch_backend import torch
from .base import StepEnds, Tensor, TensorVectorEnv
from .cuda_kernel import (
    ASKED,
    NAME,
    RUNS,
    SIMULATED,
    WORDS,
    DeviceArrays,
    KernelConstants,
    Real,
    make_constants,
    make_kernel,
    make_specification,
)

if not SIMULATED:  # the simulator has no compiler
    from numba.cuda import dispatcher
    from numba.cuda.compiler import compile_cuda, kernel_fixup
    from numba.cuda.cudadrv.nvvm import NVVM
    from numba.cuda.np.numpy_support import from_dtype

BLOCK = 128  # threads; 255 registers each leave a multiprocessor of an H200 two such blocks
_SIMULATED_BLOCK = 4
_Capability = tuple[int, int]  # of a GPU: (9, 0) is an H200


def get_ptx(constants: KernelConstants, real: Real, capability: _Capability) -> str:
    """Get a kernel's PTX, from the disk or compiled.

    Args:
        constants: Constants of the kernel.
        real: Type of floats.
        capability: Compute capability of the GPU.
    """
    folder = kernel_cache.find_kernel_folder("envs")
    versions = version("numba-cuda"), version("numba"), NVVM().get_version()
    key = json.dumps([constants, real.__name__, capability, versions])
    path = folder / f"fused-{hashlib.sha256(key.encode()).hexdigest()}.ptx" if folder else None
    if path and (data := kernel_cache.read_trusted(path)):
        digest, _, text = data.partition(b"\n")
        if digest == _hash_text(text):  # else the file is not whole
            return text.decode()
    ptx = _compile_ptx(constants, real, capability)
    if path:
        with contextlib.suppress(OSError), replace_file(path) as file:
            file.write(_hash_text(ptx.encode()) + b"\n" + ptx.encode())
    return ptx


def _hash_text(text: bytes) -> bytes:
    """Make the first line of a file: a comment of PTX with its text's hash."""
    return f"// {hashlib.sha256(text).hexdigest()}".encode()


def _compile_ptx(constants: KernelConstants, real: Real, capability: _Capability) -> str:
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


def _load_kernel(constants: KernelConstants, real: Real, device: torch.device) -> Any:
    """Load a kernel: a function of the number of rows, whether they are reset, and `DeviceArrays`.

    In numba's simulator it is plain Python, a thread after the other.
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


_NEW_ARRAYS = ("actions", "rewards", "terminated", "truncated", "final_obs", "final_reports")
"""Arrays that are new in every step; the others stay at their place."""
_TORCH = {np.uint8: torch.uint8, np.int64: torch.int64, np.float32: torch.float32}


class CudaVectorEnv(TensorVectorEnv):
    """`TensorVectorEnv` on a GPU, one CUDA thread a row and one kernel a step.

    The kernel takes the ticks, sensors, packets, observation, cost and resets; keys of new episodes
    come from each row's PCG64 on the device. The host waits only to learn whether an action is bad
    (`on_bad_action="raise"`) or an episode is over ("Disabled"). Needs torch and numba-cuda, of the
    extras `train` and `cuda`; the first env of a kind compiles for half a minute. With "SameStep"
    infos have `final_obs` and `final_info`, zeros in rows that did not end.

    Args:
        num_envs: Number of environments N.
        device: "cuda", "cuda:1", ...; "cpu" in numba's simulator (NUMBA_ENABLE_CUDASIM=1), a few
            rows for tests.
        dtype: "float64", which has the bits of `StabilityVectorEnv`, or "float32".
        autoreset_mode: "NextStep", "SameStep" or "Disabled".
        record: Whether `rows` and `packets` are written; without it they raise ValueError.
        arguments: Arguments of `StabilityEnv`.

    Raises:
        TypeError: For an argument out of place.
        ValueError: For a value out of place, and a device that is not there.
        MemoryError: Where the rows do not fit.
    """

    _has_over = True  # for all that the host knows

    def __init__(
        self, num_envs: int = 1, device: str | torch.device = "cuda",
        dtype: str | torch.dtype = "float64",
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP, *, record: bool = False,
        **arguments: Any,
    ) -> None:  # fmt: skip
        super().__init__(num_envs, device, dtype, autoreset_mode, arguments, is_uniform=True)
        if (self.device.type == "cpu") != SIMULATED:
            runs = "in numba's simulator on 'cpu'" if SIMULATED else "on a CUDA device"
            raise ValueError(f"engine='cuda' runs {runs}, got {str(device)!r}")
        self._constants = make_constants(self.config, self._mode.value, record)
        self._real = np.float64 if self.dtype == torch.float64 else np.float32
        sizes = make_specification(self._constants, self._real, num_envs, 1)
        if not SIMULATED:
            _check_memory(sizes, num_envs, self.device)
        self._kernel = _load_kernel(self._constants, self._real, self.device)
        self._memory = DeviceArrays(*(self._allocate(*spec) for spec in sizes))
        words = np.random.default_rng().integers(0, 2**32, (WORDS, num_envs))
        words[WORDS // 2] |= 1  # PCG64's increment is odd
        self._memory.generators.copy_(torch.as_tensor(words))
        self._memory.bounds.copy_(torch.as_tensor(self.config.bounds))

    def _allocate(self, kind: Any, shape: tuple[int, ...]) -> Tensor:
        """Allocate zeros of a NumPy type on the device."""
        return torch.zeros(shape, dtype=_TORCH.get(kind, self.dtype), device=self.device)

    def _start_rows(self, chosen: IntArray, seeds: dict[int, int], options: dict[str, Any]) -> None:
        """Reset rows on the device, where their generators are."""
        configs, index = self._make_configs(options, chosen)
        self._check_plants(configs)
        words = _read_words([seeding.np_random(seed)[0] for seed in seeds.values()])
        self._memory.generators[:, list(seeds)] = torch.as_tensor(words, device=self.device)
        start_index = np.zeros(self.num_envs, np.int64)  # 0: without options
        start_index[chosen] = 1 + index
        starts = [config.start for config in (self.config.base, *configs)]
        packed = np.stack([np.concatenate([x.params, x.low, x.high, x.motion]) for x in starts])
        switches = np.stack([start.switches for start in starts])
        self._memory = self._memory._replace(
            which=torch.as_tensor(start_index, device=self.device),
            starts=torch.as_tensor(packed).to(self.device, self.dtype),
            switches=torch.as_tensor(switches, device=self.device),
        )
        self._memory.over[torch.as_tensor(chosen, device=self.device)] = ASKED
        self._kernel(self.num_envs, True, self._memory)

    def _advance(self, actions: Any) -> StepEnds:
        """Start a kernel that steps rows or resets them."""
        commands = self._parse_actions(actions, torch.float32).contiguous()
        if self.config.on_bad_action != "fail":  # here the host waits
            bad = ~torch.isfinite(commands).all(1) & (self._memory.over == RUNS)
            if rows := bad.nonzero()[:, 0].tolist():
                self._refuse_actions(rows, commands)
        sizes = make_specification(self._constants, self._real, self.num_envs, 1)
        new_arrays = {name: self._allocate(*getattr(sizes, name)) for name in _NEW_ARRAYS[1:]}
        self._memory = memory = self._memory._replace(actions=commands, **new_arrays)
        self._kernel(self.num_envs, False, memory)
        ends = memory.terminated.view(torch.bool), memory.truncated.view(torch.bool)
        is_same_step = self._mode == AutoresetMode.SAME_STEP
        final = (memory.final_obs, memory.final_reports) if is_same_step else None
        return StepEnds(memory.rewards, *ends, final)

    def _get_outputs(self) -> tuple[Tensor, Tensor, Tensor]:
        return self._memory.obs, self._memory.reports, self._memory.over

    def _get_record(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        if not self._constants.record:
            raise ValueError("there is no record: build the env with record=True")
        m = self._memory
        return m.rows, m.packets, m.counts[0], m.counts[1]

    def _get_motion(self) -> Tensor:
        states: Tensor = self._memory.states
        return states[Z.motion[0] : Z.motion[-1] + 1]

    def tensors(self) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Get the state of the rows and the newest step's outcome, the env's own tensors."""
        m = self._memory
        results = m.obs, m.rewards, m.terminated, m.truncated, m.rows, m.packets
        return (m.states, m.reports, m.over), results

    def get_state(self) -> dict[str, Any]:
        """Copy the state of all rows, on the device."""
        memory = DeviceArrays(*(array.clone() for array in self._memory))
        return {"batch": self._describe_batch(), "started": self._started, "memory": memory}

    def _restore(self, snapshot: Mapping[str, Any]) -> None:
        batch, own_batch = snapshot.get("batch"), self._describe_batch()
        if batch != own_batch:
            raise ValueError(f"the snapshot is of other rows, {batch}, not {own_batch}")
        self._memory = DeviceArrays(*(x.to(self.device, copy=True) for x in snapshot["memory"]))
        self._started = snapshot["started"]

    def _describe_batch(self) -> tuple[int, KernelConstants, torch.dtype]:
        """Describe what a snapshot has to have in common with the env."""
        return self.num_envs, self._constants, self.dtype


def _read_words(generators: Sequence[np.random.Generator]) -> npt.NDArray[np.int64]:
    """Read the words (WORDS, N) of N generators of NumPy's PCG64."""
    words = np.empty((WORDS, len(generators)), np.int64)
    for i, generator in enumerate(generators):
        state: Any = generator.bit_generator.state["state"]
        for k, number in enumerate((state["state"], state["inc"])):
            words[4 * k : 4 * k + 4, i] = [number >> 32 * part & 0xFFFFFFFF for part in range(4)]
    return words


def _check_memory(sizes: DeviceArrays, count: int, device: torch.device) -> None:
    """Check that arrays of `sizes`, and the results of three steps, fit on the device."""
    needed, free = 0, torch.cuda.mem_get_info(device)[0]
    for name, (kind, shape) in sizes._asdict().items():
        copies = 3 if name in (*_NEW_ARRAYS, "obs") else 1
        needed += math.prod(shape) * np.dtype(kind).itemsize * copies
    if needed > free:
        row = -(-needed // count)
        text = f"{count} rows of {row} bytes do not fit on {device}, where {free} bytes are free"
        raise MemoryError(f"{text}: at most {free // row} rows")
