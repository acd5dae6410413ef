"""Without a driver, without memory, on another GPU: the CUDA engine says what is missing."""

import re
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("numba_cuda")

from sideslip.envs import StabilityVectorEnv  # noqa: E402
from sideslip.envs.device import cuda_env  # noqa: E402
from sideslip.envs.device.cuda_kernel import (  # noqa: E402
    SIMULATED,
    make_constants,
    make_specification,
)

pytestmark = pytest.mark.skipif(SIMULATED, reason="of real devices")


def test_rows_that_do_not_fit_are_refused_with_how_many_would(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = StabilityVectorEnv(1).config
    constants = make_constants(config, "NextStep", record=False)
    sizes = make_specification(constants, np.float64, 1000, 1)
    free, device = 0, torch.device("cuda:0")
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (free, free))
    with pytest.raises(MemoryError, match=r"1000 rows of \d+ bytes .* on cuda:0") as refused:
        cuda_env._check_memory(sizes, 1000, device)
    row = int(re.findall(r"(\d+) bytes", str(refused.value))[0])
    free = 500 * row - 1
    with pytest.raises(MemoryError, match="at most 499 rows"):
        cuda_env._check_memory(sizes, 1000, device)
    free = 1000 * row
    cuda_env._check_memory(sizes, 1000, device)


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A driver that agrees to everything and remembers what it was called with."""
    from cuda.bindings.driver import CUresult

    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0))
    monkeypatch.setattr(torch.cuda, "device", lambda device: nullcontext())
    stream = SimpleNamespace(cuda_stream=77)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: stream)
    monkeypatch.setattr(torch, "empty", lambda *size, device: None)
    fake = Mock(CUresult=CUresult)
    fake.cuModuleLoadData.return_value = CUresult.CUDA_SUCCESS, "module"
    fake.cuModuleGetFunction.return_value = CUresult.CUDA_SUCCESS, "function"
    fake.cuLaunchKernel.return_value = (CUresult.CUDA_SUCCESS,)
    return fake


def test_a_launch_has_a_thread_for_each_row_and_one_address_for_each_array(driver: Any) -> None:
    loaded = cuda_env._DriverKernel("// PTX", torch.device("cuda:0"), driver)
    driver.cuModuleLoadData.assert_called_once_with(b"// PTX\0")
    driver.cuModuleGetFunction.assert_called_once_with("module", b"sideslip_step")
    arrays = [torch.zeros(3), torch.zeros(0)]
    loaded(cuda_env.BLOCK + 1, True, arrays)
    function, *grid = driver.cuLaunchKernel.call_args.args
    assert function == "function"
    assert grid[:8] == [2, 1, 1, cuda_env.BLOCK, 1, 1, 0, 77]
    values, kinds = grid[8]
    assert values == (cuda_env.BLOCK + 1, True, arrays[0].data_ptr(), arrays[1].data_ptr())
    assert [kind.__name__ for kind in kinds] == ["c_long", "c_bool", "c_void_p", "c_void_p"]


@pytest.mark.parametrize(
    ("call", "code", "error"),
    [
        ("cuModuleLoadData", "CUDA_ERROR_NO_BINARY_FOR_GPU", RuntimeError),
        ("cuModuleLoadData", "CUDA_ERROR_UNSUPPORTED_PTX_VERSION", RuntimeError),
        ("cuLaunchKernel", "CUDA_ERROR_OUT_OF_MEMORY", MemoryError),
    ],
)
def test_what_the_driver_refuses_is_said(driver: Any, call: str, code: str, error: Any) -> None:
    getattr(driver, call).return_value = (getattr(driver.CUresult, code),)
    with pytest.raises(error, match=f"on cuda:0: {code}"):
        cuda_env._DriverKernel("// PTX", torch.device("cuda:0"), driver)(5, False, [])
