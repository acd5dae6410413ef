"""How a vehicle's numbers lie in its two packed vectors, and what an observation holds.

`params` is constant within an episode, `state` is everything that changes: a copy of both is a
complete snapshot. New parts go at the end of `_PARAMS` or `_STATE`; nothing else has to move.
"""

from typing import Any, NamedTuple

import numpy as np

from ..record import PACKET_WIDTH
from ..scenarios.driver import Driver
from ..scenarios.speed import Pace
from ..scenarios.steering import STEERING_WIDTH
from ..scenarios.tracks import Path
from ..scenarios.wind import Wind
from ..sensors.gps import Sky
from ..sensors.link import IN_FLIGHT, Link
from ..sensors.noise import Noise
from ..task.reference import Target
from ..vehicle.actuators import Lag
from ..vehicle.dynamics import Car, Motion, Road


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


class Switches(NamedTuple):
    """Integers that choose the text of the plant and the task, the same for a whole batch."""

    small_angle: int
    law: int
    reference: int
    steering: int  # kind of steering programme, used at reset
    all_samples: int  # the observation holds every fast sample
    fail_bad: int  # a non-finite action ends the episode instead of being refused
    roll: int  # the body rolls
