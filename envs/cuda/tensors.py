"""What both engines on tensors share: arguments, checked, and infos."""

from collections.abc import Mapping
from typing import Any

from ..arguments import short_repr
from ..backend.on_torch import DTYPES, torch
from ..task.failures import RUNNING
from ..task.info import REPORT, StepReport

Tensor = torch.Tensor


def parse_device(device: Any) -> torch.device:
    """The device of a name or itself, as its tensors have it: a GPU with an index, the CPU without.

    ValueError for an unknown one and one that is not there.
    """
    try:
        parsed = torch.device(device)
    except (RuntimeError, TypeError):
        parsed = None
    if parsed is None or parsed.type not in ("cpu", "cuda"):
        raise ValueError(f"unknown device {device!r}; known: 'cpu', 'cuda', 'cuda:0', ...")
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if parsed.type == "cuda" and (parsed.index or 0) >= count:
        available = ", ".join(["cpu", *(f"cuda:{i}" for i in range(count))])
        reason = (
            "" if count else ": no CUDA driver" if torch.version.cuda else ": built without CUDA"
        )
        raise ValueError(
            f"device {str(device)!r} is not there: torch {torch.__version__} finds "
            f"{available}{reason}"
        )
    if parsed.type == "cpu":
        return torch.device("cpu")
    return torch.device(
        "cuda", torch.cuda.current_device() if parsed.index is None else parsed.index
    )


def check_arguments(arguments: Mapping[str, Any]) -> None:
    """TypeError for an argument of `StabilityVectorEnv` that no engine on a device heeds."""
    for name in ("max_episode_steps", "info", "render_mode"):
        if arguments.get(name) is not None:
            raise TypeError(f"an env on a device has no {name}, got {short_repr(arguments[name])}")


def parse_dtype(dtype: Any) -> torch.dtype:
    """The type of floats of a name or itself; ValueError for another."""
    known = DTYPES | {torch_dtype: torch_dtype for torch_dtype in DTYPES.values()}
    if dtype not in known:
        raise ValueError(f"dtype is 'float64' or 'float32', got {dtype!r}")
    return known[dtype]


def read_infos(report: Tensor) -> dict[str, Any]:
    """The numbers of `info` of every row, (N,) each, from a report (len(Report), N)."""
    infos: dict[str, Any] = dict(zip(StepReport._fields, report[: REPORT.failure], strict=False))
    infos["failure"] = failure = report[REPORT.failure].to(torch.int64)
    infos["is_success"] = (report[REPORT.ended] == 1.0) & (failure == RUNNING)
    return infos
