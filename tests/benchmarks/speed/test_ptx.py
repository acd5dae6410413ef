"""What is counted of the fused kernel's PTX."""

import subprocess
from pathlib import Path

import pytest

pytest.importorskip("numba_cuda")

from sideslip.benchmarks.speed.ptx import _assemble_kernel, _count_by_kind

TEXT = """
.visible .entry step(
\t.param .u64 step_param_0
)
{
$L__BB0_1:
\tld.param.u64 \t%rd1, [step_param_0];
\tmul.rn.f64 \t%fd2, %fd1, %fd1;
\t@%p1 bra \t$L__BB0_1;
\tfma.rn.f32 \t%f1, %f2, %f3, %f4;
\tdiv.rn.f64 \t%fd3, %fd2, %fd1;
\tcvt.f64.f32 \t%fd4, %f1;
\tmax.f64 \t%fd5, %fd4, %fd3;
\tret;
}
"""


def test_arithmetic_is_told_from_the_rest() -> None:
    assert _count_by_kind(TEXT) == {
        "instructions": 8,
        "on float64": 2,
        "on float32": 1,
        "fused": 1,
        "divisions, roots": 1,
    }


SAID = "ptxas info : 16 bytes stack frame, 4 bytes spill stores\nptxas info : Used 42 registers"


@pytest.mark.parametrize("status", [0, 1])
def test_the_assembler_says_what_a_thread_holds_or_ends_the_count(
    status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without one on the path nothing is counted."""
    monkeypatch.setenv("PATH", str(tmp_path))
    assert _assemble_kernel(TEXT, (9, 0)) == {}
    ptxas = tmp_path / "ptxas"
    ptxas.write_text(f"#!/bin/sh\necho '{SAID}' >&2\nexit {status}\n")
    ptxas.chmod(0o755)
    if status:
        with pytest.raises(subprocess.CalledProcessError):
            _assemble_kernel(TEXT, (9, 0))
    else:
        held = {"registers": "42", "stack, bytes": "16", "spilled, bytes": "4"}
        assert _assemble_kernel(TEXT, (9, 0)) == held
