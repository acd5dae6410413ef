"""Instructions and registers of the fused CUDA kernel, counted without a GPU.

`python -m sideslip.benchmarks.speed.ptx --out table.md`
"""

import re
import shutil
import subprocess
import tempfile
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import typer
from rich.console import Console

from ...envs.device.cuda_env import get_ptx
from ...envs.device.cuda_kernel import make_constants
from ...envs.vector import StabilityVectorEnv
from ..harness.results import check_writable, write_text

_ARITHMETIC = "add|sub|mul|fma|div|rcp|sqrt"


def _count_opcodes(text: str) -> Counter[str]:
    opcode = r"^\t(?:@!?%\w+ )?([a-z][a-z0-9]*(?:\.[a-z0-9:]+)*)[\s;]"
    return Counter(re.findall(opcode, text, re.M))


def _count_by_kind(text: str) -> dict[str, Any]:
    totals = _count_opcodes(text)

    def count_matching(pattern: str) -> int:
        return sum(count for name, count in totals.items() if re.match(pattern, name))

    return {
        "instructions": totals.total(),
        "on float64": count_matching(rf"({_ARITHMETIC})\S*\.f64"),
        "on float32": count_matching(rf"({_ARITHMETIC})\S*\.f32"),
        "fused": count_matching("fma|mad"),
        "divisions, roots": count_matching(r"(div|rcp|sqrt)\S*\.f"),
    }


def _assemble_kernel(text: str, capability: tuple[int, int]) -> dict[str, Any]:
    """Count a thread's registers and spilled bytes with `ptxas`; {} without it on the path."""
    if shutil.which("ptxas") is None:
        return {}
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "kernel.ptx")
        source.write_text(text)
        arch = f"-arch=sm_{capability[0]}{capability[1]}"
        command = ["ptxas", "-v", arch, str(source), "-o", f"{source}.cubin"]
        run = subprocess.run(command, capture_output=True, text=True, check=True)
    patterns = {
        "registers": r"Used (\d+) registers",
        "stack, bytes": r"(\d+) bytes stack",
        "spilled, bytes": r"(\d+) bytes spill stores",
    }
    return {name: re.findall(pattern, run.stderr)[-1] for name, pattern in patterns.items()}


def _main(
    env: Annotated[str, typer.Option(help="An environment's id.")] = "sideslip/YawFusion-v0",
    out: Annotated[Path | None, typer.Option(help="Write the table as Markdown.")] = None,
) -> None:
    """Count the kernel's instructions for an H200 (sm_90), in float64 and float32."""
    check_writable(out)
    config = StabilityVectorEnv(1, **gym.spec(env).kwargs).config
    options = make_constants(config, "NextStep", record=False)
    columns: list[dict[str, Any]] = []
    for real in (np.float64, np.float32):
        text = get_ptx(options, real, (9, 0))
        columns.append({"": real.__name__} | _count_by_kind(text) | _assemble_kernel(text, (9, 0)))
    cells = [[name, *(str(column[name]) for column in columns)] for name in columns[0]]
    lines = [f"| {' | '.join(line)} |" for line in cells]
    table = "\n".join([lines[0], "|---|---|---|", *lines[1:]]) + "\n"
    Console().print(table, highlight=False, markup=False, soft_wrap=True)
    if out is not None:
        write_text(out, table)


if __name__ == "__main__":
    typer.run(_main)
