"""The suite `speed`: CPU time of steps, ticks, learning and first use, and the engine's targets.

The first use is measured in fresh processes. Kernels are compiled once and cached on disk; a cold
one is compiled in a temporary folder.
"""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from ..harness.results import Cell, Column, Line, ResultTable, Suite
from ..harness.stats import Bound, Estimate, compute_range
from ..report.study import Request, Study, format_verdict, summarise_names
from . import env_steps, plant
from .timing import FULL, QUICK, TimeTable

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
    marks = json.loads(_run_python(f"{_WARM}print(json.dumps(marks))", limit=LIMIT))
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


def _measure_first_use(quick: bool) -> TimeTable:
    """Measure the first use; in a quick run by a few processes, and nothing is compiled."""
    note = (
        "Fresh processes; the first gym.make imports numba, which is shown apart and counted. "
        "Cold: environment and exact-kf, single and batch, with nothing on disk."
    )
    table = TimeTable("Cost of the first use", "cpu_seconds", "CPU-s", note)
    try:
        runs = [_measure_first_step() for _ in range((_QUICK_RUNS if quick else _RUNS) + 1)][1:]
        for name in _STEPS:
            table.times[f"first use: {name}"] = np.array([run[name] for run in runs])
        counted = ("import numba", "gym.make", "first reset", "first step")
        table.times[FIRST] = np.sum([table.times[f"first use: {name}"] for name in counted], axis=0)
    except subprocess.TimeoutExpired:
        table.absent[FIRST] = "no kernels are cached on disk here"
    if quick:
        table.absent[KERNEL] = "in the full form only"  # it takes minutes
    else:
        seconds = [kernel_seconds for _, kernel_seconds in _measure_compilation()]
        table.times["cold compile of all kernels"] = np.array([sum(seconds)])
        table.times[KERNEL] = np.array([max(seconds)])
    return table


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


def _evaluate_targets(tables: Sequence[TimeTable]) -> list[Line]:
    """Make a line of each target: what was measured, in ratios round by round, and if it is met."""
    times = {name: taken for table in tables for name, taken in table.times.items()}
    lines = list[Line]()
    for name, over, workload, limit in TARGETS:
        goal = f"{limit} {'x' if over else 'CPU-s'}"
        line: dict[str, Cell] = {"scenario": name, "goal": goal}
        if workload in times and (not over or over in times):
            rounds = times[over] / times[workload] if over else times[workload]
            measured = compute_range(rounds)
            is_met = "yes" if limit.is_met(measured.value) else "no"
            line |= {"n": len(rounds), "measured": measured, "met": is_met}
            line |= {"ratio": measured} if over else {}
        lines.append(line)
    return lines


def _measure(request: Request) -> list[TimeTable]:
    """Measure in this process, where workloads take turns; a quick run compiles nothing."""
    effort = QUICK if request.quick else FULL
    return [
        env_steps.measure_steps(effort),
        env_steps.measure_filters(effort),
        plant.measure_plants(effort),
        env_steps.measure_learners(effort),
        _measure_first_use(request.quick),
    ]


def _add_tables(suite: Suite, tables: Sequence[TimeTable]) -> None:
    lines = _evaluate_targets(tables)
    suite.add_rows(lines, salt="", env_version="")
    measured = Column("measured", "measured [range]", form=".3g")
    columns = Column("scenario", "figure"), Column("goal", "target"), "met", measured
    note = "Ratios are taken round by round, in CPU time; the median counts."
    suite.tables.append(ResultTable("Targets", columns, lines, note, keyed=False))
    for table in tables:
        table.add_table(suite)


def _format(value: float) -> str:
    return Estimate(value).inline(digits=".3g")


def _make_verdict(tables: Sequence[TimeTable]) -> str:
    us = {x: float(np.median(y)) for table in tables for x, y in table.times.items()}
    step_time, batch_time = us[env_steps.FUSION_V1], us[env_steps.V1_AT_ONCE]
    rivals = (env_steps.CARTPOLE, env_steps.LANE)
    over = [f"{_format(us[x] / step_time)} for {x}" for x in rivals if x in us]
    lines = _evaluate_targets(tables)
    count = sum(line.get("met") == "yes" for line in lines)
    missed = [f"{line['scenario']} ({_format(line['measured'].value)} of {line['goal']})"
              for line in lines if line.get("met") == "no"]  # fmt: skip
    shortfall = f"; not met: {summarise_names(missed, 1)}" if missed else ""
    return format_verdict(
        f"10 ms of driving cost {_format(step_time)} us on one core, {_format(batch_time)} us a "
        f"car where {env_steps.COUNT} drive at once.",
        f"One env-step of ours is 1; it is {' and '.join(over)}." if over else "",
        f"{count} of {len(lines)} goals are met{shortfall}.",
        "Why: one compiled call an env-step, cars side by side in the processor's wide registers.",
        "Not covered: other machines; compare ratios, not microseconds.",
    )


STUDY = Study(
    "speed", "What a step costs",
    "CPU time on one thread, median and range of rounds in which the entries of a table "
    "take turns. An env-step of ours is 10 ms of driving: ten ticks of plant and sensors.",
    (0, 0), _measure, _add_tables, _make_verdict,
)  # fmt: skip
