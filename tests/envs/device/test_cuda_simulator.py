"""The kernel's semantics in numba's CUDA simulator, in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("numba_cuda")

STEPS = Path(__file__).with_name("test_cuda_steps.py")


def test_the_steps_are_those_of_the_compiled_engine() -> None:
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
