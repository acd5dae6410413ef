"""What the first use costs, by processes of their own: imports, the first step, compilation.

Kernels are compiled once and cached on disk; a cold one is compiled in a temporary folder.
"""

import json
import os
import subprocess
import sys
from tempfile import TemporaryDirectory

from ..harness.results import Row, Suite, Table
from .contestants import AbsentError
from .timing import spread

FIRST = "gym.make to the first step, kernels on disk"
KERNEL = "cold compile of the dearest kernel"
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


def warm() -> dict[str, float]:
    """CPU seconds of each thing a fresh process does up to its first step.

    Raises AbsentError where that takes minutes, because no kernels are cached on disk.
    """
    try:
        marks: list[tuple[str, float]] = json.loads(_python(_WARM, limit=LIMIT))
    except subprocess.TimeoutExpired:
        raise AbsentError("no kernels are cached on disk here") from None
    before = [0.0, *(at for _, at in marks)]
    return {name: at - before[i] for i, (name, at) in enumerate(marks)}


def cold(code: str = _COLD) -> list[tuple[str, float]]:
    """(name, CPU seconds) of each kernel that some code has compiled with nothing on disk, without
    those of kernels that it calls as they stand."""
    with TemporaryDirectory() as folder:
        here = {"XDG_CACHE_HOME": folder, "NUMBA_CACHE_DIR": ""}
        printed = _python(f"{_WATCH}\n{code}\nprint(json.dumps(taken))", here)
    return [(str(name), float(seconds)) for name, seconds in json.loads(printed)]


def _python(code: str, variables: dict[str, str] | None = None, limit: float | None = None) -> str:
    """What code prints in an interpreter of its own that finds the same packages."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)} | (variables or {})
    command = [sys.executable, "-c", code]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=limit)
    if run.returncode:
        raise RuntimeError(f"a fresh process failed:\n{run.stderr}")
    return run.stdout.splitlines()[-1]


def add(suite: Suite, runs: int, compiling: bool) -> tuple[dict[str, list[float]], dict[str, str]]:
    """Rows and tables; the targets' CPU seconds, and why others are absent.

    runs: processes whose first one does not count. compiling: also everything cold, which takes
    minutes.
    """
    seconds, absent = dict[str, list[float]](), dict[str, str]()
    try:
        seconds[FIRST] = _add_first(suite, runs)
    except AbsentError as error:
        absent[FIRST] = str(error)
    if compiling:
        kernels = cold()
        seconds[KERNEL] = [max(taken for _, taken in kernels)]
        _add_kernels(suite, kernels)
    else:
        absent[KERNEL] = "in the full form only"
    return seconds, absent


def _add_first(suite: Suite, runs: int) -> list[float]:
    """Rows and a table of fresh processes; CPU seconds up to the first step."""
    taken = [warm() for _ in range(runs + 1)][1:]
    columns = {name: [run[name] for run in taken] for name in taken[0]}
    ours = ("import numba", "gym.make", "first reset", "first step")
    columns[FIRST] = [sum(run[name] for name in ours) for run in taken]
    columns["whole process"] = [sum(run.values()) for run in taken]
    cells = []
    for name, values in columns.items():
        middle, low, high = spread(values)
        _row(suite, f"first use: {name}", values)
        cells.append([name, f"{middle:.3f}", f"{low:.3f} .. {high:.3f}"])
    note = "Fresh processes. The first gym.make imports numba, which is shown apart and counted."
    suite.tables.append(
        Table("Cost of the first use", ("", "CPU-s", "range"), cells, note, keyed=False)
    )
    return columns[FIRST]


def _add_kernels(suite: Suite, kernels: list[tuple[str, float]]) -> None:
    total: dict[str, float] = {}
    for name, taken in kernels:  # a function may be compiled for several types
        total[name] = total.get(name, 0.0) + taken
    order = sorted(total, key=lambda name: -total[name])
    cells = [[name, f"{total[name]:.2f}"] for name in order if total[name] >= 0.5]
    cells.append(["all", f"{sum(total.values()):.2f}"])
    for name in total:
        _row(suite, f"cold compile: {name}", [total[name]])
    _row(suite, "cold compile: all", [sum(total.values())])
    suite.tables.append(
        Table(
            "Cost of compiling",
            ("kernel", "CPU-s"),
            cells,
            "Nothing on disk; environment and exact-kf, single and batch. Kernels that are called "
            "from Python, with what they call where it was not compiled before; those above 0.5 s.",
            keyed=False,
        )
    )


def _row(suite: Suite, name: str, values: list[float]) -> None:
    middle, low, high = spread(values)
    suite.rows.append(
        Row(suite.name, name, "cpu_seconds", middle, low=low, high=high, n=len(values))
    )
