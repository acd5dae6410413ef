"""Env-steps a second of the device engine against the size of the batch, and what bounds them.

`python -m sideslip.benchmarks.speed.device --device cuda --out table.md`
"""

import itertools
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from ...envs.device import make_device_env
from ...envs.engine.layout import PARAMS_WIDTH
from ...envs.numerics.torch_backend import torch
from ..harness.parallel import report_user_errors
from ..harness.results import check_writable, write_text
from .timing import Taken

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
    rate, low, high = Taken(env.num_envs * _STEPS / x for x in taken).range
    size, moved = env.num_envs, _count_bytes(env)
    return [
        f"{size}",
        f"{env.dtype}".removeprefix("torch."),
        f"{rate:.3g}",
        f"{low:.3g} .. {high:.3g}",
        f"{1e6 * size / rate:.4g}",
        f"{moved:.0f}",
        f"{100.0 * rate * moved / copied:.2g} %",
    ]


_HEADS = (
    *("N", "floats", "env-steps/s", "range", "us a step of all", "bytes a row, at least"),
    "of a copy's bandwidth",
)


def _main(
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:1, ...")] = "cpu",
    dtype: Annotated[list[str] | None, typer.Option(help="float32, float64; both.")] = None,
    env: Annotated[str, typer.Option(help="An environment's id.")] = "sideslip/YawFusion-v0",
    count: Annotated[list[int] | None, typer.Option(help="Rows of a batch; repeatable.")] = None,
    engine: Annotated[str, typer.Option(help="cuda, or torch: on a GPU, else torch.")] = "",
    compiled: Annotated[bool, typer.Option("--compile", help="By torch.compile.")] = False,
    out: Annotated[Path | None, typer.Option(help="Write the table as Markdown.")] = None,
) -> None:
    """Measure env-steps per second, resets included, against the size of the batch."""
    check_writable(out)
    console, copied = Console(), 0.0
    lines: list[Sequence[str]] = [_HEADS, ["---"] * len(_HEADS)]
    engine = engine or ("cuda" if device.startswith("cuda") else "torch")
    options: dict[str, Any] = {"engine": engine, "on_bad_action": "fail"}
    options |= {"compile": True} if compiled else {}
    for kind, size in itertools.product(dtype or ("float32", "float64"), count or _COUNTS):
        batch = make_device_env(env, size, device=device, dtype=kind, **options)
        copied = copied or _measure_bandwidth(batch.device)
        lines.append(_measure(batch, copied))
        console.print(f"{size}, {kind}: {lines[-1][2]} env-steps/s", highlight=False)
        del batch
    hardware = f"CPU, {torch.get_num_threads()} threads of torch"
    if device.startswith("cuda"):
        hardware = torch.cuda.get_device_name(torch.device(device))
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    text = (
        f"`{shlex.join(['python', '-m', 'sideslip.benchmarks.speed.device', *sys.argv[1:]])}`\n\n"
        f"{hardware}, torch {torch.__version__}; {env}, engine {engine}, "
        f"{'compiled' if compiled else 'not compiled'}. Median and range of {_ROUNDS} rounds of "
        f"{_STEPS} steps, wall time. A copy on the device moves {copied / 1e9:.3g} GB/s.\n\n"
        f"{table}\n"
    )
    console.print(text, highlight=False, markup=False, soft_wrap=True)
    if out is not None:
        write_text(out, text)


if __name__ == "__main__":
    with report_user_errors():
        typer.run(_main)
