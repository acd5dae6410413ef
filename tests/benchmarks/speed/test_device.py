"""The gradient engine's table in a small form."""

import subprocess
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch")

from sideslip.benchmarks.speed import device as device_speed  # noqa: E402
from sideslip.benchmarks.speed.device import _assemble_kernel, _count_by_kind  # noqa: E402

ENV_ID = "sideslip/YawVision-v0"


def test_the_table_has_a_line_for_each_size_and_says_how_it_was_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"_COPIED": 1 << 20, "_STEPS": 1, "_ROUNDS": 2}.items():
        monkeypatch.setattr(device_speed, name, value)
    out = tmp_path / "table.md"
    device_speed._main("cpu", ["float64"], ENV_ID, [4, 8], out=out)
    command, _, text, _, *lines = out.read_text().splitlines()
    assert "sideslip.benchmarks.speed.device" in command
    assert f"{ENV_ID}, engine torch, not compiled. Median and range of 2 rounds of 1 steps" in text
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert [row[0] for row in rows] == ["N", "---", "4", "8"]
    for count, dtype, rate, spread, *_ in rows[2:]:
        assert dtype == "float64"
        low, high = map(float, spread.split(" .. "))
        assert 0.0 < low <= float(rate) <= high, count


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"device": "gpu"}, "unknown device 'gpu'"), ({"dtype": ["half"]}, "dtype is 'float64' or")],
)
def test_a_wrong_word_is_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        device_speed._main(**wrong, count=[2], out=None)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_says_so_and_writes_nothing(tmp_path: Path) -> None:
    out = tmp_path / "table.md"
    with pytest.raises(ValueError, match="device 'cuda' is not there: torch"):
        device_speed._main("cuda", count=[2], out=out)
    assert not out.exists()


def test_a_table_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="there is no such folder"):
        device_speed._main(device="gpu", out=tmp_path / "no" / "table.md")


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
    assert _assemble_kernel(TEXT) == {}
    ptxas = tmp_path / "ptxas"
    ptxas.write_text(f"#!/bin/sh\necho '{SAID}' >&2\nexit {status}\n")
    ptxas.chmod(0o755)
    if status:
        with pytest.raises(subprocess.CalledProcessError):
            _assemble_kernel(TEXT)
    else:
        held = {"registers": "42", "stack, bytes": "16", "spilled, bytes": "4"}
        assert _assemble_kernel(TEXT) == held


def test_counting_code_takes_no_option_of_steps() -> None:
    with pytest.raises(ValueError, match="--device ptx counts code"):
        device_speed._main(device="ptx", dtype=["float16"])
