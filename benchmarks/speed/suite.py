"""The suite speed: everything side by side in one run, and the targets."""

from rich.console import Console

from ..harness.results import Suite
from . import env_steps, first_use, learning, plant, targets
from .timing import FULL, QUICK

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
    for part in (plant, learning):
        more, away = part.add(suite, effort)
        taken |= more
        absent |= away
    seconds, away = first_use.add(suite, QUICK_RUNS if quick else RUNS, compiling=not quick)
    targets.add(suite, taken, seconds, absent | away)
    return suite
