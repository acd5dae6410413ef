"""What the engine is meant to reach, and what it does: ratios round by round."""

from collections.abc import Mapping
from typing import NamedTuple

from ..harness.results import Suite, Table
from . import env_steps, first_use, learning, plant
from .contestants import absences, add_row, three
from .timing import Taken, spread


class Target(NamedTuple):
    """A goal: the CPU time of `over` as a multiple of that of `ours` in the same round, or where
    `over` is "" CPU seconds.

    most: it is a price, at most this much; otherwise at least `least`.
    """

    name: str
    over: str
    ours: str
    least: float = 0.0
    most: float = float("inf")

    @property
    def text(self) -> str:
        """ ">= 25 x", "<= 1.1 x" or "<= 5 CPU-s"."""
        unit = "x" if self.over else "CPU-s"
        return f">= {self.least:g} {unit}" if self.least else f"<= {self.most:g} {unit}"

    def met(self, value: float) -> bool:
        """Whether a value is where it should be."""
        return self.least <= value <= self.most


TARGETS = (
    Target("gym.make step, lane-keeping over ours", env_steps.LANE, env_steps.FUSION, 30.0),
    Target("gym.make step, CartPole over ours", env_steps.CARTPOLE, env_steps.FUSION, 1.4),
    Target("1024 at once, lane-keeping over ours", env_steps.LANE, env_steps.AT_ONCE, 200.0),
    Target("1024 at once, CartPole over ours", env_steps.CARTPOLES, env_steps.AT_ONCE, 0.1),
    Target("plant, C over ours", plant.C, plant.OURS, 0.85),
    Target("delay at the tick over none", env_steps.LATE, env_steps.NONE_LATE, most=1.1),
    Target(
        "full-covariance filter in the loop, 1024 at once, Pendulum over ours",
        env_steps.PENDULUMS,
        env_steps.FILTERED,
        4.5,
    ),
    Target("PPO, 256 at once, Pendulum over ours", learning.PENDULUM, learning.OURS, 1.7),
    Target(first_use.FIRST, "", first_use.FIRST, most=0.5),
    Target(first_use.KERNEL, "", first_use.KERNEL, most=5.0),
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
        needed = [target.over, target.ours] if target.over else [target.ours]
        away = [name for name in needed if name not in {**taken, **seconds}]
        cells.append([target.name, target.text, "", "", "not measured"])
        if away:
            missing |= {name: absent.get(name, "not run") for name in away}
            continue
        if target.over:
            pairs = zip(taken[target.over], taken[target.ours], strict=True)
            ratios = [other / own for other, own in pairs]
            middle, *ends = add_row(suite, target.name, "ratio", ratios)
        else:
            middle, *ends = spread(seconds[target.ours])
        met = "met" if target.met(middle) else "not met"
        cells[-1][2:] = three(middle), " .. ".join(map(three, ends)), met
    header = ("figure", "target", "measured", "range", "")
    note = "Ratios are taken round by round, in CPU time; the median counts." + absences(missing)
    suite.tables.insert(0, Table("Targets", header, cells, note, keyed=False))
