"""Processes of their own, with kernels and settings of their own."""

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[2] / "src"


def start(
    code: str,
    variables: Mapping[str, str],
    *arguments: str,
    cwd: Path | None = None,
    source: Path = SOURCE,
) -> subprocess.Popen[str]:
    """Start code with every warning an error, without settings of the compiler but `variables`."""
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("NUMBA_", "SIDESLIP_"))
    }
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-c", code, *arguments],
        env=environment | {"PYTHONPATH": str(source)} | dict(variables),
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process: subprocess.Popen[str]) -> tuple[list[str], str]:
    """The lines that a process printed, and what it wrote to standard error."""
    printed, complained = process.communicate(timeout=200)
    assert process.returncode == 0, complained
    return printed.splitlines(), complained
