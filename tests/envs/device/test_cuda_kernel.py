"""The kernel without a GPU: its PTX for an H200, the file of that, its keys, its simulation."""

import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("numba_cuda")

from sideslip.envs import StabilityVectorEnv
from sideslip.envs.device import cuda_env
from sideslip.envs.device.cuda_env import _read_words
from sideslip.envs.device.cuda_kernel import (
    NAME,
    DeviceArrays,
    KernelConstants,
    _draw_key,
    make_constants,
)
from sideslip.envs.numerics import kernel_cache

H200 = (9, 0)
STEPS = Path(__file__).with_name("test_cuda_steps.py")
ARITHMETIC = re.compile(r"^\t(?:@!?%\w+ )?(?:add|sub|mul|fma|div|rcp|sqrt)\S*\.(f32|f64)\s", re.M)
OPCODE = re.compile(r"^\t(?:@!?%\w+ )?([a-z][a-z0-9]*(?:\.[a-z0-9:]+)*)[\s;]", re.M)


def how() -> KernelConstants:
    env = StabilityVectorEnv(1, sensors="fusion", reference="model", scenario="random-steering")
    return make_constants(env.config, "NextStep", record=False)


def test_float64_has_no_contraction_and_rounds_as_ieee_asks() -> None:
    text = cuda_env.get_ptx(how(), np.float64, H200)
    found = Counter(OPCODE.findall(text))
    assert ".target sm_90" in text
    head = text[text.index(f".visible .entry {NAME}(") :].partition(")")[0]
    kinds = re.findall(r"\.param \.(\w+)", head)  # what `_DriverKernel` hands over
    assert kinds == ["u64", "u8", *["u64"] * len(DeviceArrays._fields)]
    assert not [each for each in found if each.startswith(("fma", "mad"))]
    floats = [each for each in found if re.match(r"(add|sub|mul|div|rcp|sqrt)\S*\.f", each)]
    assert len(floats) >= 6
    for each in floats:  # without .rn the assembler may contract, with .approx it is another number
        assert re.fullmatch(r"\w+\.rn\.f(64|32)", each), each
    assert sum(found[each] for each in floats) < 8000
    assert not re.search(r"\bcall\b", text)  # of a library's functions, whose bits are its own


def test_float32_has_no_double_in_the_ticks() -> None:
    text = cuda_env.get_ptx(how(), np.float32, H200)
    assert OPCODE.findall(text).count("fma.rn.f32") > 500
    kinds = ARITHMETIC.findall(text)
    assert kinds.count("f64") < 0.02 * kinds.count("f32")
    longest = max("".join("s" if each == "f32" else " " for each in kinds).split(), key=len)
    assert len(longest) > 0.5 * len(kinds)  # the loop over the ticks, which lies in one piece


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache, and a compiler that counts."""
    made: list[Any] = []
    tmp_path.chmod(0o700)

    def compiled(*arguments: Any) -> str:
        made.append(arguments)
        return f"text {len(made)}"

    monkeypatch.setattr(cuda_env, "_compile_ptx", compiled)
    monkeypatch.setattr(kernel_cache, "find_kernel_folder", lambda layer: tmp_path)
    return tmp_path


def test_each_gpu_has_its_own_file(folder: Path) -> None:
    assert cuda_env.get_ptx(how(), np.float64, H200) == "text 1"
    assert cuda_env.get_ptx(how(), np.float64, H200) == "text 1"
    assert cuda_env.get_ptx(how(), np.float64, (8, 0)) == "text 2"
    assert cuda_env.get_ptx(how(), np.float32, H200) == "text 3"
    assert len(list(folder.iterdir())) == 3


@pytest.mark.plain
def test_keys_are_those_of_numpys_generator() -> None:
    """A row's generator on the device draws what NumPy's draws on the host."""
    generators = [np.random.default_rng(seed) for seed in range(200)]
    words = _read_words(generators)
    for i, generator in enumerate(generators):
        for _ in range(5):
            key = int(generator.integers(0, 2**64, dtype=np.uint64))
            assert _draw_key(words[:, i]) == (key & 0xFFFFFFFF, key >> 32)
    assert np.array_equal(words, _read_words(generators))  # and it stands where NumPy's does


def test_the_simulated_steps_are_those_of_the_compiled_engine() -> None:
    """In numba's CUDA simulator, in a process of its own."""
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "--confcutdir=tests", "-q", "-x", "-p", "no:xdist", STEPS],
        env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1"},
        cwd=STEPS.parents[3],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout[-5000:] + run.stderr[-2000:]
    assert "skipped" not in run.stdout.splitlines()[-1]
