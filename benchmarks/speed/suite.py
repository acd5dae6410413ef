"""What the engine is meant to reach, and what it does: ratios round by round.

The suite speed: everything side by side in one run, and the targets.
"""

from collections.abc import Mapping
from typing import NamedTuple

from rich.console import Console

from ..harness.results import ResultTable, Suite
from ..harness.study import format_verdict, summarise_names
from . import env_steps, first_use, learning, plant
from .timing import FULL, QUICK, Taken, add_row, compute_range, format_absences, format_three_digits


class SpeedTarget(NamedTuple):
    """A goal: the CPU time of `over` as a multiple of that of `workload` in the same round, or
    where `over` is "" CPU seconds.

    max_value: it is a price, at most this much; otherwise at least `min_value`.
    """

    name: str
    over: str
    workload: str
    min_value: float = 0.0
    max_value: float = float("inf")

    @property
    def text(self) -> str:
        """ ">= 25 x", "<= 1.1 x" or "<= 5 CPU-s"."""
        unit = "x" if self.over else "CPU-s"
        return (
            f">= {self.min_value:g} {unit}" if self.min_value else f"<= {self.max_value:g} {unit}"
        )

    def met(self, value: float) -> bool:
        """Whether a value is where it should be."""
        return self.min_value <= value <= self.max_value


TARGETS = (
    SpeedTarget("gym.make step, lane-keeping over ours", env_steps.LANE, env_steps.FUSION, 30.0),
    SpeedTarget("gym.make step, CartPole over ours", env_steps.CARTPOLE, env_steps.FUSION, 1.4),
    SpeedTarget("1024 at once, lane-keeping over ours", env_steps.LANE, env_steps.AT_ONCE, 200.0),
    SpeedTarget("1024 at once, CartPole over ours", env_steps.CARTPOLES, env_steps.AT_ONCE, 0.1),
    SpeedTarget("plant, C over ours", plant.C, plant.PLANT, 0.85),
    SpeedTarget("delay at the tick over none", env_steps.LATE, env_steps.NONE_LATE, max_value=1.1),
    SpeedTarget(
        "full-covariance filter in the loop, 1024 at once, Pendulum over ours",
        env_steps.PENDULUMS,
        env_steps.FILTERED,
        4.5,
    ),
    SpeedTarget("PPO, 256 at once, Pendulum over ours", learning.PENDULUM, learning.PPO_YAW, 1.7),
    SpeedTarget(first_use.FIRST, "", first_use.FIRST, max_value=0.5),
    SpeedTarget(first_use.KERNEL, "", first_use.KERNEL, max_value=5.0),
)


def add(
    suite: Suite,
    taken: Mapping[str, Taken],
    seconds: Mapping[str, Taken],
    absent: Mapping[str, str],
) -> None:
    """A row for each target that was measured, and the table, first of all, of all of them.

    taken: of the contestants. seconds: measured CPU seconds of first use. absent: why others were
    not measured.
    """
    cells, missing = [], dict[str, str]()
    for target in TARGETS:
        needed = [target.over, target.workload] if target.over else [target.workload]
        absent_names = [name for name in needed if name not in {**taken, **seconds}]
        cells.append([target.name, target.text, "", "", "not measured"])
        if absent_names:
            missing |= {name: absent.get(name, "not run") for name in absent_names}
            continue
        if target.over:
            pairs = zip(taken[target.over], taken[target.workload], strict=True)
            ratios = [reference_time / workload_time for reference_time, workload_time in pairs]
            middle, *ends = add_row(suite, target.name, "ratio", ratios)
        else:
            middle, *ends = compute_range(seconds[target.workload])
        met = "met" if target.met(middle) else "not met"
        cells[-1][2:] = (
            format_three_digits(middle),
            " .. ".join(map(format_three_digits, ends)),
            met,
        )
    header = ("figure", "target", "measured", "range", "")
    note = "Ratios are taken round by round, in CPU time; the median counts." + format_absences(
        missing
    )
    suite.tables.insert(0, ResultTable("Targets", header, cells, note, keyed=False))


RIVALS = (env_steps.CARTPOLE, env_steps.LANE)
RUNS, QUICK_RUNS = 5, 2  # fresh processes


def run(quick: bool = False, console: Console | None = None) -> Suite:
    """CPU time of steps, ticks, learning and first use: median of rounds, and range.

    quick: few rounds, nothing compiled anew.
    """
    suite = Suite(
        "speed",
        "What a step costs",
        "CPU time on one thread, median and range of rounds in which the contestants of a table "
        "take turns. An env-step of ours is 10 ms of driving: ten ticks of plant and sensors.",
    )
    effort = QUICK if quick else FULL
    taken, absent = env_steps.add(suite, effort)
    env_steps.add_filters(suite, effort)
    for part in (plant, learning):
        more, more_absent = part.add(suite, effort)
        taken |= more
        absent |= more_absent
    seconds, more_absent = first_use.add(suite, QUICK_RUNS if quick else RUNS, compiling=not quick)
    add(suite, taken, seconds, absent | more_absent)
    suite.verdict = make_verdict(taken, suite.tables[0])
    return suite


def make_verdict(taken: Mapping[str, Taken], goals: ResultTable) -> str:
    """The verdict. taken: CPU us of the contestants; goals: the table of targets."""
    us = {name: compute_range(times)[0] for name, times in taken.items()}
    step_time = us[env_steps.FUSION]
    over = [
        f"{format_three_digits(us[name] / step_time)} for {name}" for name in RIVALS if name in us
    ]
    met = [line[0] for line in goals.cells if line[-1] == "met"]
    missed = [f"{name} ({measured} of {goal})" for name, goal, measured, _, outcome in goals.cells
              if outcome == "not met"]  # fmt: skip
    shortfall = f"; not met: {summarise_names(missed, 1)}" if missed else ""
    return format_verdict(
        f"10 ms of driving cost {format_three_digits(step_time)} us on one core, "
        f"{format_three_digits(us[env_steps.AT_ONCE])} us "
        f"a car where {env_steps.COUNT} drive at once.",
        f"One env-step of ours is 1; it is {' and '.join(over)}." if over else "",
        f"{len(met)} of {len(goals.cells)} goals are met{shortfall}.",
        "Why: one compiled call an env-step, cars side by side in the processor's wide registers.",
        "Not covered: other machines; compare ratios, not microseconds.",
    )
