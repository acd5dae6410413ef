"""CPU time of the first use, in fresh processes: imports, the first step, compilation.

Kernels are compiled once and cached on disk; a cold one is compiled in a temporary folder.
"""

import json
import os
import subprocess
import sys
from tempfile import TemporaryDirectory

from ..harness.results import ResultTable, Suite
from .timing import AbsentError, Taken

FIRST = "gym.make to the first step, kernels on disk"
KERNEL = "cold compile of the dearest kernel"
_RUNS, _QUICK_RUNS = 5, 2  # fresh processes
LIMIT = 60.0  # s, on the wall, of a process that has nothing to compile

_WARM = """
import json, time
marks = [("interpreter", time.process_time())]
def done(name):
    marks.append((name, time.process_time()))
import gymnasium, numpy
done("import gymnasium")
import sideslip
done("import sideslip")
import numba
done("import numba")
env = gymnasium.make("sideslip/YawFusion-v0")
done("gym.make")
env.reset(seed=0)
done("first reset")
env.step(numpy.zeros(1, numpy.float32))
done("first step")
print(json.dumps(marks))
"""

_WATCH = """
import json, logging

taken = []

class Watch(logging.Handler):
    def emit(self, record):
        if len(record.args) == 2:  # a kernel's name and its own CPU seconds
            taken.append(record.args)

logging.getLogger("sideslip.compiler").addHandler(Watch())
logging.getLogger("sideslip.compiler").setLevel(logging.INFO)
"""

_COLD = """
import gymnasium as gym, numpy as np
from sideslip.estimators import EstimateObservation
from sideslip.estimators.vector import EstimateObservation as EstimateObservations
how = {"estimator": "exact-kf", "options": {"gains": "covariance"}}
def run(env, shape):
    env.reset(seed=0)
    env.step(np.zeros(shape, np.float32))
id = "sideslip/YawFusion-v0"
run(gym.make(id), 1)
run(gym.make_vec(id, num_envs=8), (8, 1))
run(EstimateObservation(gym.make(id), **how), 1)
run(EstimateObservations(gym.make_vec(id, num_envs=8), **how), (8, 1))
"""


def _measure_first_step() -> dict[str, float]:
    """Measure the CPU seconds of what a process does up to its first step; kernels are cached."""
    try:
        marks: list[tuple[str, float]] = json.loads(_run_python(_WARM, limit=LIMIT))
    except subprocess.TimeoutExpired:
        raise AbsentError("no kernels are cached on disk here") from None
    before = [0.0, *(at for _, at in marks)]
    return {name: at - before[i] for i, (name, at) in enumerate(marks)}


def _measure_compilation(code: str = _COLD) -> list[tuple[str, float]]:
    """Measure the CPU seconds of each kernel that code compiles with nothing on disk."""
    with TemporaryDirectory() as folder:
        environment = {"XDG_CACHE_HOME": folder, "NUMBA_CACHE_DIR": ""}
        printed = _run_python(f"{_WATCH}\n{code}\nprint(json.dumps(taken))", environment)
    return [(str(name), float(seconds)) for name, seconds in json.loads(printed)]


def _run_python(
    code: str, variables: dict[str, str] | None = None, limit: float | None = None
) -> str:
    """Run code in a fresh interpreter that finds the same packages; the last line it prints."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)} | (variables or {})
    command = [sys.executable, "-c", code]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=limit)
    if run.returncode:
        raise RuntimeError(f"a fresh process failed:\n{run.stderr}")
    return run.stdout.splitlines()[-1]


def add(suite: Suite, quick: bool) -> tuple[dict[str, Taken], dict[str, str]]:
    """Add rows and a table.

    Args:
        suite: Suite that gets the results.
        quick: Whether a few processes do and nothing is compiled, which takes minutes.

    Returns:
        CPU seconds of the targets, and reasons of absence, by name.
    """
    columns, absent = dict[str, Taken](), dict[str, str]()
    try:
        taken = [_measure_first_step() for _ in range((_QUICK_RUNS if quick else _RUNS) + 1)][1:]
        columns = {f"first use: {name}": Taken(run[name] for run in taken) for name in taken[0]}
        counted = ("import numba", "gym.make", "first reset", "first step")
        columns[FIRST] = Taken(sum(run[name] for name in counted) for run in taken)
    except AbsentError as error:
        absent[FIRST] = str(error)
    if not quick:
        kernels = _measure_compilation()
        columns["cold compile of all kernels"] = Taken([sum(seconds for _, seconds in kernels)])
        columns[KERNEL] = Taken([max(seconds for _, seconds in kernels)])
    else:
        absent[KERNEL] = "in the full form only"
    cells = []
    for name, values in columns.items():
        middle, low, high = values.add_row(suite, name, "cpu_seconds").range
        cells.append([name, f"{middle:.3f}", f"{low:.3f} .. {high:.3f}"])
    note = (
        "Fresh processes; the first gym.make imports numba, which is shown apart and counted. "
        "Cold: environment and exact-kf, single and batch, with nothing on disk."
    )
    header = ("", "CPU-s", "range")
    suite.tables.append(ResultTable("Cost of the first use", header, cells, note, False))
    return {name: columns[name] for name in (FIRST, KERNEL) if name in columns}, absent
