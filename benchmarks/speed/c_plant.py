"""The plant in C, compiled on the spot: `plant.c` beside this module."""

import ctypes
import os
import shutil
import subprocess
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from .contestants import AbsentError

FLAGS = ("-O3", "-march=native", "-ffp-contract=off")
VECTORS = (
    "-fopenmp-simd",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-signed-zeros",
    "-fschedule-insns",
    "-fsched-pressure",
)
"""Flags with which gcc makes vectors of square roots, floor and choices: the fastest of those that
were tried; no number changes."""


def find_compiler() -> str:
    """The C compiler: that of the variable CC, or the first one found.

    Raises AbsentError where there is none.
    """
    for name in (os.environ.get("CC", ""), "gcc", "clang", "cc"):
        if name and (path := shutil.which(name)):
            return path
    raise AbsentError("no C compiler")


def read_source() -> str:
    """The text of `plant.c`."""
    return files(__package__).joinpath("plant.c").read_text(encoding="utf-8")


def load_c_plant(block: int) -> Any:
    """The function `plant` of `plant.c` for blocks of so many cars, loaded.

    Raises AbsentError where there is no compiler, or none that can compile it.
    """
    with TemporaryDirectory() as folder:
        library = Path(folder) / "plant.so"
        flags = [*FLAGS, *VECTORS, f"-DBLOCK={block}", "-shared", "-fPIC"]
        command = [find_compiler(), *flags, "-x", "c", "-", "-o", str(library)]
        run = subprocess.run(command, input=read_source(), capture_output=True, text=True)
        if run.returncode:
            last = (run.stderr.strip().splitlines() or ["it gave no reason"])[-1]
            raise AbsentError(f"{command[0]} does not compile it: {last}")
        function = ctypes.CDLL(str(library)).plant  # stays when the file is gone
    pointers = [ctypes.c_void_p] * 7
    function.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_double, *pointers]
    function.restype = None
    return function
