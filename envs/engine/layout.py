"""How a vehicle's numbers lie in its two packed vectors, and what an observation holds.

`params` is constant within an episode, `state` is everything that changes: a copy of both is a
complete snapshot. New parts go at the end of `_PARAMS` or `_STATE`; nothing else has to move.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .actuators import Lag
from .driver import Driver
from .dynamics import Car, Motion, Road
from .pace import Pace
from .programme import STEERING_WIDTH, Wind
from .record import FAST, FAST_UNITS, PACKET_WIDTH, SLOW_NAMES, SLOW_VALUES
from .reference import Target
from .sensors import IN_FLIGHT, Link, Noise, Sky
from .tracks import Path

Array = npt.NDArray[np.float64]


class Disturbance(NamedTuple):
    """Ornstein-Uhlenbeck lateral force and yaw moment, per tick."""

    force: Any  # N, standard deviation
    moment: Any  # N m
    keep: Any  # what is left after a tick
    fresh: Any  # sqrt(1 - keep^2)


class Task(NamedTuple):
    """The episode's length and limits."""

    duration: Any  # ticks
    half_width: Any  # m, of the road or proving ground
    yaw_scale: Any  # N m of action 1
    yaw_first: Any  # 1: yaw moment before acceleration
    spin: Any  # rad of sideslip
    authority: Any  # rad of added steering, of action 1
    slew: Any  # rad a tick, of added steering
    stop: Any  # rad, of the whole steering angle


class Change(NamedTuple):
    """Tyres that change in mid-run."""

    tick: Any  # from which on
    front: Any  # factors on the cornering stiffness
    rear: Any


class Drive(NamedTuple):
    """Actuators, the driver's integral and the disturbances now acting."""

    T_l: Any
    T_r: Any
    delta_f: Any
    integral: Any
    F_d: Any
    N_d: Any
    slewing: Any  # rad, the added steering that is asked for, within its rate
    added: Any  # rad, the added steering that acts


class Clock(NamedTuple):
    """Integers of an episode, kept as floats."""

    key_low: Any
    key_high: Any
    tick: Any
    failure: Any
    redraws: Any
    next_due: Any  # arrival tick of the next packet


class Slow(NamedTuple):
    """Where one slow sensor stands, and its newest sample."""

    frames: Any  # captured so far
    next_capture: Any
    captured: Any  # tick of the newest delivered sample, NEVER before the first
    v_0: Any
    v_1: Any
    v_2: Any
    v_3: Any
    v_4: Any
    v_5: Any
    arrived: Any  # tick of its delivery


def _offsets(parts: dict[str, int]) -> dict[str, int]:
    ends = np.cumsum([0, *parts.values()])
    return dict(zip([*parts, "end"], map(int, ends), strict=True))


_PARAMS = _offsets(
    {
        "car": len(Car._fields),
        "road": len(Road._fields),
        "motor": len(Lag._fields),
        "steer": len(Lag._fields),
        "wind": len(Wind._fields),
        "pace": len(Pace._fields),
        "noise": len(Noise._fields),
        "camera": len(Link._fields),
        "gps": len(Link._fields),
        "target": len(Target._fields),
        "disturbance": len(Disturbance._fields),
        "task": len(Task._fields),
        "steering": STEERING_WIDTH,
        "sky": len(Sky._fields),
        "driver": len(Driver._fields),
        "path": len(Path._fields),
        "change": len(Change._fields),
    }
)
_STATE = _offsets(
    {
        "motion": len(Motion._fields),
        "drive": len(Drive._fields),
        "clock": len(Clock._fields),
        "camera": len(Slow._fields),
        "gps": len(Slow._fields),
        "queue": 2 * IN_FLIGHT * PACKET_WIDTH,
        "sky": 1,  # deviation of log HDOP from its median
        "driver": 1,  # rad, the driver's steering command
        "under_way": 1,  # how many packets are in the queue
    }
)


class ParamsAt(NamedTuple):
    """Where each part of the packed parameters starts."""

    car: int
    road: int
    motor: int
    steer: int
    wind: int
    pace: int
    noise: int
    camera: int
    gps: int
    target: int
    disturbance: int
    task: int
    steering: int
    sky: int
    driver: int
    path: int
    change: int
    end: int


class StateAt(NamedTuple):
    """Where each part of the packed state starts."""

    motion: int
    drive: int
    clock: int
    camera: int
    gps: int
    queue: int
    sky: int
    driver: int
    under_way: int
    end: int


P, Z = ParamsAt(**_PARAMS), StateAt(**_STATE)


class Entry(NamedTuple):
    """One number of an observation: its name, unit and finite bounds."""

    name: str
    unit: str
    low: float
    high: float


SAMPLED = 6  # the first columns of a fast row are sensors; the policy sees last and mean of each
AGE_CAP = 10.0  # s

_FAST_BOUNDS = (10.0, 50.0, 50.0, 10.0, 100.0, 100.0, 1.0, 2000.0, 2000.0, 1.0, 50.0)
_SLOW_BOUNDS = {
    "psi": float(np.pi),
    "y_l": 200.0,
    "course": float(np.pi),
    "speed": 100.0,
    "X": 1e5,
    "Y": 1e5,
    "hdop": 100.0,
    "satellites": 50.0,
}


def observation_layout(slow: tuple[str, ...], n: int, fast: str) -> tuple[Entry, ...]:
    """The entries of an observation.

    slow: names of the slow sensors present. n: ticks of a control period. fast: "summary" (last
    sample and mean over the step) or "all" (every sample of the step).
    """
    entries = []
    for column in range(SAMPLED):
        name, unit, bound = FAST._fields[column], FAST_UNITS[column], _FAST_BOUNDS[column]
        names = (name, f"{name}_mean") if fast == "summary" else [f"{name}_{j}" for j in range(n)]
        entries += [Entry(each, unit, -bound, bound) for each in names]
    for name in ("steer", "torque_left", "torque_right", "steer_command"):
        column = getattr(FAST, name)
        bound = _FAST_BOUNDS[column]
        entries.append(Entry(name, FAST_UNITS[column], -bound, bound))
    for sensor in SLOW_NAMES:
        if sensor in slow:
            for name, unit in SLOW_VALUES[sensor]:
                bound = _SLOW_BOUNDS[name]
                entries.append(Entry(f"{sensor}_{name}", unit, -bound, bound))
            entries.append(Entry(f"{sensor}_age", "s", 0.0, AGE_CAP))
            entries.append(Entry(f"{sensor}_fresh", "-", 0.0, 1.0))
    entries.append(Entry("beta_ref", "rad", -1.0, 1.0))
    entries.append(Entry("gamma_ref", "rad/s", -10.0, 10.0))
    return tuple(entries)
