"""The integers and reports that the kernel shares with the environment."""

from typing import NamedTuple

RUNNING, SPIN, OFF_ROAD, NOT_FINITE, BAD_ACTION = range(5)
FAILURES = ("none", "spin", "off-road", "not-finite", "bad-action")
REFUSED = -1


class Switches(NamedTuple):
    """Integers that choose the text of the plant and the task, the same for a whole batch."""

    small_angle: int
    law: int
    reference: int
    steering: int  # kind of steering programme, used at reset
    all_samples: int  # the observation holds every fast sample
    fail_bad: int  # a non-finite action ends the episode instead of being refused
    roll: int  # the body rolls


class Report(NamedTuple):
    """Columns of the numbers that go into `info`."""

    t: int = 0
    beta: int = 1
    gamma: int = 2
    psi: int = 3
    beta_ref: int = 4
    gamma_ref: int = 5
    steer: int = 6
    yaw_moment: int = 7
    cost: int = 8
    failure: int = 9
    packets: int = 10
    reward: int = 11
    ended: int = 12  # 1 the time is over


REPORT = Report()
