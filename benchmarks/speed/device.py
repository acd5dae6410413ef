"""Env-steps a second of the device engine against the size of the batch, and what bounds them.

`python -m sideslip.benchmarks.speed.device --device cuda --out table.md`. With `--device
ptx` it counts instructions and registers of the fused CUDA kernel instead, which needs no GPU.
"""

import itertools
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import typer
from rich.console import Console

from ...envs.device import make_device_env
from ...envs.engine.layout import PARAMS_WIDTH
from ...envs.numerics.torch_backend import torch
from ...envs.vector import StabilityVectorEnv
from ..harness.parallel import report_user_errors
from ..harness.results import check_writable, write_text
from ..harness.stats import compute_range

_COUNTS = (1024, 16384, 65536, 262144, 1048576)
_ROUNDS, _STEPS = 5, 20  # rounds that count, each of so many steps
_COPIED = 1 << 28  # bytes, beyond every cache


def _measure_seconds(work: Callable[[], object], device: torch.device) -> float:
    start = time.perf_counter()
    work()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - start


def _measure_bandwidth(device: torch.device) -> float:
    """Measure the bandwidth of a copy within the device (bytes/s, read and written)."""
    one = torch.ones(_COPIED, dtype=torch.uint8, device=device)
    other = torch.empty_like(one)
    taken = [_measure_seconds(lambda: other.copy_(one), device) for _ in range(4)]
    return 2.0 * _COPIED / min(taken[1:])


def _count_bytes(env: Any) -> float:
    """Count the bytes a row's step has to move: it reads parameters and state, writes the rest."""
    held, brought = env.tensors()
    read = sum(tensor.nbytes for tensor in held) + env.num_envs * PARAMS_WIDTH * env.dtype.itemsize
    written = sum(tensor.nbytes for tensor in (*held, *brought))
    return float((read + written) / env.num_envs)


def _measure(env: Any, copied: float) -> list[str]:
    """Measure a batch in rounds, after a first one: a line of the table; copied: as in the note."""
    env.reset(seed=0)
    actions = torch.zeros(env.action_space.shape or (), device=env.device)

    def run_steps() -> None:
        for _ in range(_STEPS):
            env.step(actions)

    taken = [_measure_seconds(run_steps, env.device) for _ in range(_ROUNDS + 1)][1:]
    size, moved = env.num_envs, _count_bytes(env)
    rate, low, high = compute_range(size * _STEPS / np.array(taken))
    return [
        f"{size}", f"{env.dtype}".removeprefix("torch."), f"{rate:.3g}", f"{low:.3g} .. {high:.3g}",
        f"{1e6 * size / rate:.4g}", f"{moved:.0f}", f"{100.0 * rate * moved / copied:.2g} %",
    ]  # fmt: skip


_HEADS: Sequence[str] = (
    *("N", "floats", "env-steps/s", "range", "us a step of all", "bytes a row, at least"),
    "of a copy's bandwidth",
)

_ARITHMETIC = "add|sub|mul|fma|div|rcp|sqrt"


def _count_by_kind(text: str) -> dict[str, Any]:
    opcode = r"^\t(?:@!?%\w+ )?([a-z][a-z0-9]*(?:\.[a-z0-9:]+)*)[\s;]"
    totals = Counter(re.findall(opcode, text, re.M))

    def count_matching(pattern: str) -> int:
        return sum(count for name, count in totals.items() if re.match(pattern, name))

    return {
        "instructions": totals.total(),
        "on float64": count_matching(rf"({_ARITHMETIC})\S*\.f64"),
        "on float32": count_matching(rf"({_ARITHMETIC})\S*\.f32"),
        "fused": count_matching("fma|mad"),
        "divisions, roots": count_matching(r"(div|rcp|sqrt)\S*\.f"),
    }


def _assemble_kernel(text: str) -> dict[str, Any]:
    """Count a thread's registers and spilled bytes with `ptxas`; {} without it on the path."""
    if shutil.which("ptxas") is None:
        return {}
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "kernel.ptx")
        source.write_text(text)
        command = ["ptxas", "-v", "-arch=sm_90", str(source), "-o", f"{source}.cubin"]
        run = subprocess.run(command, capture_output=True, text=True, check=True)
    patterns = {
        "registers": r"Used (\d+) registers",
        "stack, bytes": r"(\d+) bytes stack",
        "spilled, bytes": r"(\d+) bytes spill stores",
    }
    return {name: re.findall(pattern, run.stderr)[-1] for name, pattern in patterns.items()}


def _make_kernel_table(env: str) -> str:
    """Count the kernel's instructions for an H200 (sm_90), in float64 and float32."""
    from ...envs.device.cuda_env import get_ptx
    from ...envs.device.cuda_kernel import make_constants

    config = StabilityVectorEnv(1, **gym.spec(env).kwargs).config
    options = make_constants(config, "NextStep", record=False)
    columns: list[dict[str, Any]] = []
    for real in (np.float64, np.float32):
        text = get_ptx(options, real, (9, 0))
        columns.append({"": real.__name__} | _count_by_kind(text) | _assemble_kernel(text))
    return _format_table([[name, *(f"{x[name]}" for x in columns)] for name in columns[0]])


def _format_table(lines: Sequence[Sequence[str]]) -> str:
    """Format lines in Markdown, the heads first."""
    heads, *rest = (f"| {' | '.join(line)} |" for line in lines)
    return "\n".join([heads, f"{'|---' * len(lines[0])}|", *rest, ""])


def _print_text(text: str, out: Path | None) -> None:
    """Print a text, and write it to a file unless that is None."""
    Console().print(text, highlight=False, markup=False, soft_wrap=True)
    if out is not None:
        write_text(out, text)


def _main(
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:1, ..., or ptx.")] = "cpu",
    dtype: Annotated[list[str] | None, typer.Option(help="float32, float64; both.")] = None,
    env: Annotated[str, typer.Option(help="An environment's id.")] = "sideslip/YawFusion-v0",
    count: Annotated[list[int] | None, typer.Option(help="Rows of a batch; repeatable.")] = None,
    engine: Annotated[str, typer.Option(help="cuda, or torch: on a GPU, else torch.")] = "",
    compiled: Annotated[bool, typer.Option("--compile", help="By torch.compile.")] = False,
    out: Annotated[Path | None, typer.Option(help="Write the table as Markdown.")] = None,
) -> None:
    """Measure env-steps per second, resets included; on ptx count the CUDA kernel's code."""
    check_writable(out)
    if device == "ptx":
        if dtype or count or engine or compiled:
            raise ValueError("--device ptx counts code: no --dtype, --count, --engine, --compile")
        _print_text(_make_kernel_table(env), out)
        return
    copied, lines = 0.0, [_HEADS]
    engine = engine or ("cuda" if device.startswith("cuda") else "torch")
    options: dict[str, Any] = {"engine": engine, "on_bad_action": "fail"}
    options |= {"compile": True} if compiled else {}
    for kind, size in itertools.product(dtype or ("float32", "float64"), count or _COUNTS):
        batch = make_device_env(env, size, device=device, dtype=kind, **options)
        copied = copied or _measure_bandwidth(batch.device)
        lines.append(_measure(batch, copied))
        Console().print(f"{size}, {kind}: {lines[-1][2]} env-steps/s", highlight=False)
        del batch
    hardware = f"CPU, {torch.get_num_threads()} threads of torch"
    if device.startswith("cuda"):
        hardware = torch.cuda.get_device_name(torch.device(device))
    text = (
        f"`{shlex.join(['python', '-m', 'sideslip.benchmarks.speed.device', *sys.argv[1:]])}`\n\n"
        f"{hardware}, torch {torch.__version__}; {env}, engine {engine}, "
        f"{'compiled' if compiled else 'not compiled'}. Median and range of {_ROUNDS} rounds of "
        f"{_STEPS} steps, wall time. A copy on the device moves {copied / 1e9:.3g} GB/s.\n\n"
        f"{_format_table(lines)}"
    )
    _print_text(text, out)


if __name__ == "__main__":
    with report_user_errors():
        typer.run(_main)
