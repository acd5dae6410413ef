"""The suite speed: everything side by side in one run, and the targets."""

from collections.abc import Mapping

from rich.console import Console

from ..harness.results import ResultTable, Suite
from ..harness.verdict import format_verdict, summarise_names
from . import env_steps, first_use, learning, plant, targets
from .contestants import format_three_digits
from .timing import FULL, QUICK, Taken, compute_range

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
    targets.add(suite, taken, seconds, absent | more_absent)
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
