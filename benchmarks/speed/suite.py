"""The suite `speed`: CPU time of steps, ticks, learning and first use, and the engine's targets.

The first use is measured in fresh processes. Kernels are compiled once and cached on disk; a cold
one is compiled in a temporary folder.
"""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from functools import partial
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from ..harness.results import ResultTable, Suite
from ..harness.stats import Bound
from ..report.study import Request, Study, format_verdict, summarise_names
from . import env_steps, plant
from .timing import FULL, QUICK, AbsentError, Taken, format_absences, format_three_digits

FIRST = "gym.make to the first step, kernels on disk"
KERNEL = "cold compile of the dearest kernel"
_RUNS, _QUICK_RUNS = 5, 2  # fresh processes
LIMIT = 60.0  # s, on the wall, of a process that has nothing to compile

_STEPS = {
    "interpreter": "import json, time; marks = []",
    "import gymnasium": "import gymnasium, numpy",
    "import sideslip": "import sideslip",
    "import numba": "import numba",
    "gym.make": "env = gymnasium.make('sideslip/YawFusion-v0')",
    "first reset": "env.reset(seed=0)",
    "first step": "env.step(numpy.zeros(1, numpy.float32))",
}  # what a process does up to its first step
_WARM = "".join(f"{code}\nmarks.append(time.process_time())\n" for code in _STEPS.values())

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
        marks = json.loads(_run_python(f"{_WARM}print(json.dumps(marks))", limit=LIMIT))
    except subprocess.TimeoutExpired:
        raise AbsentError("no kernels are cached on disk here") from None
    return dict(zip(_STEPS, np.diff(marks, prepend=0.0).tolist(), strict=True))


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


def _add_first_use(suite: Suite, quick: bool) -> tuple[dict[str, Taken], dict[str, str]]:
    """Add rows and a table; returns CPU seconds of the targets, and reasons of absence, by name.

    In a quick run a few processes do, and nothing is compiled, which takes minutes.
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


class _Target(NamedTuple):
    """A limit for the ratio of CPU times, over / workload, of a round, or for CPU seconds."""

    name: str
    over: str  # "": CPU seconds of the workload
    workload: str
    limit: Bound


_MIN = partial(Bound, ">=")
TARGETS = (
    _Target("gym.make step, lane-keeping over ours", env_steps.LANE, env_steps.FUSION, _MIN(30.0)),
    _Target("gym.make step, CartPole over ours", env_steps.CARTPOLE, env_steps.FUSION, _MIN(1.4)),
    _Target("1024 at once, lane-keeping over ours", env_steps.LANE, env_steps.AT_ONCE, _MIN(200.0)),
    _Target("1024 at once, CartPole over ours", env_steps.CARTPOLES, env_steps.AT_ONCE, _MIN(0.1)),
    _Target("plant, C over ours", plant.C, plant.PLANT, _MIN(0.85)),
    _Target("delay at the tick over none", env_steps.LATE, env_steps.NONE_LATE, Bound("<=", 1.1)),
    _Target("full-covariance filter in the loop, 1024 at once, Pendulum over ours",
        env_steps.PENDULUMS, env_steps.FILTERED, _MIN(4.5)),
    _Target("PPO, 256 at once, Pendulum over ours",
        env_steps.PENDULUM, env_steps.PPO_YAW, _MIN(1.7)),
    _Target(FIRST, "", FIRST, Bound("<=", 0.5)),
    _Target(KERNEL, "", KERNEL, Bound("<=", 5.0)),
)  # fmt: skip


def _add_targets(suite: Suite, taken: Mapping[str, Taken], absent: Mapping[str, str]) -> None:
    """Add rows of measured targets, and before all tables that of all; `absent` has reasons."""
    cells, missing = [], dict[str, str]()
    for target in TARGETS:
        needed = [target.over, target.workload] if target.over else [target.workload]
        absent_names = [name for name in needed if name not in taken]
        unit = "x" if target.over else "CPU-s"
        cells.append([target.name, f"{target.limit} {unit}", "", "", "not measured"])
        if absent_names:
            missing |= {name: absent.get(name, "not run") for name in absent_names}
            continue
        if target.over:
            pairs = zip(taken[target.over], taken[target.workload], strict=True)
            measured = Taken(over / workload for over, workload in pairs)
            measured.add_row(suite, target.name, "ratio")
        else:
            measured = taken[target.workload]
        met = "met" if target.limit.is_met(measured.range.value) else "not met"
        cells[-1][2:] = *measured.cells, met
    header = ("figure", "target", "measured", "range", "")
    note = "Ratios are taken round by round, in CPU time; the median counts."
    note += format_absences(missing)
    suite.tables.insert(0, ResultTable("Targets", header, cells, note, keyed=False))


_SpeedResults = tuple[Mapping[str, Taken], Suite]  # us a unit by name, and all rows and tables


def _measure(request: Request) -> _SpeedResults:
    """Measure in this process, where workloads take turns; a quick run compiles nothing."""
    measured, effort = Suite("speed", "", ""), QUICK if request.quick else FULL
    taken, absent = dict[str, Taken](), dict[str, str]()
    for make in (env_steps.make_workloads, plant.make_workloads, env_steps.make_learners):
        workloads = make()
        taken |= workloads.measure(measured, effort)
        absent |= workloads.absent
        if make is env_steps.make_workloads:
            env_steps.add_filters(measured, effort)
    seconds, more_absent = _add_first_use(measured, request.quick)
    _add_targets(measured, taken | seconds, absent | more_absent)
    return taken, measured


def _add_tables(suite: Suite, results: _SpeedResults) -> None:
    _, measured = results
    suite.rows += measured.rows
    suite.tables += measured.tables


def _make_verdict(taken: Mapping[str, Taken], goals: ResultTable) -> str:
    us = {name: times.range.value for name, times in taken.items()}
    step_time, batch_time = us[env_steps.FUSION_V1], us[env_steps.V1_AT_ONCE]
    rivals = (env_steps.CARTPOLE, env_steps.LANE)
    over = [f"{format_three_digits(us[x] / step_time)} for {x}" for x in rivals if x in us]
    met = [line[0] for line in goals.cells if line[-1] == "met"]
    missed = [f"{name} ({measured} of {goal})" for name, goal, measured, _, outcome in goals.cells
              if outcome == "not met"]  # fmt: skip
    shortfall = f"; not met: {summarise_names(missed, 1)}" if missed else ""
    return format_verdict(
        f"10 ms of driving cost {format_three_digits(step_time)} us on one core, "
        f"{format_three_digits(batch_time)} us a car where {env_steps.COUNT} drive at once.",
        f"One env-step of ours is 1; it is {' and '.join(over)}." if over else "",
        f"{len(met)} of {len(goals.cells)} goals are met{shortfall}.",
        "Why: one compiled call an env-step, cars side by side in the processor's wide registers.",
        "Not covered: other machines; compare ratios, not microseconds.",
    )


STUDY = Study(
    "speed", "What a step costs",
    "CPU time on one thread, median and range of rounds in which the entries of a table "
    "take turns. An env-step of ours is 10 ms of driving: ten ticks of plant and sensors.",
    (0, 0),
    _measure, _add_tables,
    lambda results: _make_verdict(results[0], results[1].tables[0]),
)  # fmt: skip
