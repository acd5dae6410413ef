"""The suite `speed`: CPU time of steps, ticks, learning and first use, and the engine's targets."""

from collections.abc import Mapping
from typing import NamedTuple

from ..harness.results import ResultTable, Suite
from ..harness.verdict import format_verdict, summarise_names
from ..report.study import Request, Study
from . import env_steps, first_use, learning, plant
from .timing import FULL, QUICK, Taken, format_absences, format_three_digits


class _SpeedTarget(NamedTuple):
    """A limit for the ratio of CPU times, over / workload, of a round, or for CPU seconds."""

    name: str
    over: str  # "": CPU seconds of the workload
    workload: str
    min_value: float = 0.0
    max_value: float = float("inf")

    @property
    def text(self) -> str:
        """Limit with its unit, as ">= 25 x" or "<= 5 CPU-s"."""
        limit = f">= {self.min_value:g}" if self.min_value else f"<= {self.max_value:g}"
        return f"{limit} {'x' if self.over else 'CPU-s'}"

    def met(self, value: float) -> bool:
        """Check whether a value meets the target."""
        return self.min_value <= value <= self.max_value


TARGETS = (
    _SpeedTarget("gym.make step, lane-keeping over ours", env_steps.LANE, env_steps.FUSION, 30.0),
    _SpeedTarget("gym.make step, CartPole over ours", env_steps.CARTPOLE, env_steps.FUSION, 1.4),
    _SpeedTarget("1024 at once, lane-keeping over ours", env_steps.LANE, env_steps.AT_ONCE, 200.0),
    _SpeedTarget("1024 at once, CartPole over ours", env_steps.CARTPOLES, env_steps.AT_ONCE, 0.1),
    _SpeedTarget("plant, C over ours", plant.C, plant.PLANT, 0.85),
    _SpeedTarget("delay at the tick over none", env_steps.LATE, env_steps.NONE_LATE, max_value=1.1),
    _SpeedTarget("full-covariance filter in the loop, 1024 at once, Pendulum over ours",
        env_steps.PENDULUMS, env_steps.FILTERED, 4.5),
    _SpeedTarget("PPO, 256 at once, Pendulum over ours", learning.PENDULUM, learning.PPO_YAW, 1.7),
    _SpeedTarget(first_use.FIRST, "", first_use.FIRST, max_value=0.5),
    _SpeedTarget(first_use.KERNEL, "", first_use.KERNEL, max_value=5.0),
)  # fmt: skip


def _add_targets(suite: Suite, taken: Mapping[str, Taken], absent: Mapping[str, str]) -> None:
    """Add rows of measured targets, and before all tables that of all; `absent` has reasons."""
    cells, missing = [], dict[str, str]()
    for target in TARGETS:
        needed = [target.over, target.workload] if target.over else [target.workload]
        absent_names = [name for name in needed if name not in taken]
        cells.append([target.name, target.text, "", "", "not measured"])
        if absent_names:
            missing |= {name: absent.get(name, "not run") for name in absent_names}
            continue
        if target.over:
            pairs = zip(taken[target.over], taken[target.workload], strict=True)
            measured = Taken(over / workload for over, workload in pairs)
            measured.add_row(suite, target.name, "ratio")
        else:
            measured = taken[target.workload]
        met = "met" if target.met(measured.range.value) else "not met"
        cells[-1][2:] = *measured.cells, met
    header = ("figure", "target", "measured", "range", "")
    note = "Ratios are taken round by round, in CPU time; the median counts."
    note += format_absences(missing)
    suite.tables.insert(0, ResultTable("Targets", header, cells, note, keyed=False))


_RIVALS = (env_steps.CARTPOLE, env_steps.LANE)


class _SpeedResults(NamedTuple):
    """What was measured: CPU times a unit (us) by name, and their rows and tables."""

    taken: Mapping[str, Taken]
    measured: Suite


def _measure(request: Request) -> _SpeedResults:
    """Measure in this process, where workloads take turns; a quick run compiles nothing."""
    measured, effort = Suite("speed", "", ""), request.choose(FULL, QUICK)
    taken, absent = dict[str, Taken](), dict[str, str]()
    for part in (env_steps, plant, learning):
        workloads = part.make_workloads()
        taken |= workloads.measure(measured, effort)
        absent |= workloads.absent
        if part is env_steps:
            env_steps.add_filters(measured, effort)
    seconds, more_absent = first_use.add(measured, request.quick)
    _add_targets(measured, taken | seconds, absent | more_absent)
    return _SpeedResults(taken, measured)


def _add_tables(suite: Suite, results: _SpeedResults) -> None:
    suite.rows += results.measured.rows
    suite.tables += results.measured.tables


def _make_verdict(taken: Mapping[str, Taken], goals: ResultTable) -> str:
    us = {name: times.range.value for name, times in taken.items()}
    step_time, batch_time = us[env_steps.FUSION_V1], us[env_steps.V1_AT_ONCE]
    over = [f"{format_three_digits(us[x] / step_time)} for {x}" for x in _RIVALS if x in us]
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
    lambda results: _make_verdict(results.taken, results.measured.tables[0]),
)  # fmt: skip
