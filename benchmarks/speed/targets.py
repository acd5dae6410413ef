"""What the engine is meant to reach, and what it does: ratios round by round."""

from collections.abc import Mapping
from dataclasses import dataclass

from ..harness.results import Row, Suite, Table
from . import env_steps, first_use, learning, plant
from .contestants import absences, three
from .timing import Taken, ratios, spread


@dataclass(frozen=True)
class Target:
    """A goal: the cost of `over` as a multiple of the cost of `ours`, in CPU time of one round.

    most: the multiple is a price, at most this much; otherwise at least `least`.
    """

    name: str
    over: str
    ours: str
    least: float | None = None
    most: float | None = None

    @property
    def text(self) -> str:
        """ ">= 25 x" or "<= 1.1 x"."""
        return f">= {self.least:g} x" if self.most is None else f"<= {self.most:g} x"

    def met(self, value: float) -> bool:
        """Whether a value is where it should be."""
        return value >= (self.least or 0.0) if self.most is None else value <= self.most


TARGETS = (
    Target("gym.make step, lane-keeping over ours", env_steps.LANE, env_steps.FUSION, 25.0),
    Target("gym.make step, CartPole over ours", env_steps.CARTPOLE, env_steps.FUSION, 1.2),
    Target("1024 at once, lane-keeping over ours", env_steps.LANE, env_steps.AT_ONCE, 300.0),
    Target("1024 at once, CartPole over ours", env_steps.CARTPOLES, env_steps.AT_ONCE, 0.2),
    Target("plant, C over ours", plant.C, plant.OURS, 0.85),
    Target("delay at the tick over none", env_steps.LATE, env_steps.NONE_LATE, most=1.1),
    Target(
        "full-covariance filter in the loop, 1024 at once, Pendulum over ours",
        env_steps.PENDULUM,
        env_steps.FULL_COVARIANCE,
        2.5,
    ),
    Target("learned env-step, PPO on Pendulum over ours", learning.PENDULUM, learning.OURS, 15.0),
)
SECONDS = {first_use.FIRST: 0.5, first_use.KERNEL: 5.0}
"""CPU seconds, at most."""


def add(
    suite: Suite,
    taken: Mapping[str, Taken],
    seconds: Mapping[str, list[float]],
    absent: Mapping[str, str],
) -> None:
    """A row for each target that was measured, and the table, first of all, of all of them.

    taken: of the contestants. seconds: measured CPU seconds of first use. absent: why others were
    not measured.
    """
    cells, missing = [], dict[str, str]()
    for target in TARGETS:
        away = [name for name in (target.over, target.ours) if name not in taken]
        if away:
            missing |= {name: absent.get(name, "not run") for name in away}
            cells.append([target.name, target.text, "", "", "not measured"])
            continue
        values = ratios(taken[target.over].cpu, taken[target.ours].cpu)
        cells.append([target.name, target.text, *_said(suite, target.name, "ratio", values)])
        cells[-1].append("met" if target.met(spread(values)[0]) else "not met")
    for name, most in SECONDS.items():
        cells.append([name, f"<= {most:g} CPU-s"])
        if name in seconds:
            cells[-1] += _said(suite, name, "cpu_seconds", seconds[name])
            cells[-1].append("met" if spread(seconds[name])[0] <= most else "not met")
        else:
            missing[name] = absent.get(name, "not run")
            cells[-1] += ["", "", "not measured"]
    suite.tables.insert(
        0,
        Table(
            "Targets",
            ("figure", "target", "measured", "range", ""),
            cells,
            "Ratios are taken round by round, in CPU time; the median counts." + absences(missing),
            keyed=False,
        ),
    )


def _said(suite: Suite, name: str, metric: str, values: list[float]) -> list[str]:
    """A row; median and range as text."""
    middle, low, high = spread(values)
    suite.rows.append(Row(suite.name, name, metric, middle, low=low, high=high, n=len(values)))
    return [three(middle), f"{three(low)} .. {three(high)}"]
