"""State by name: where the numbers of an episode lie in its two packed vectors.

`params` is constant within an episode, `state` is everything that changes: a copy of both is a
complete snapshot. `P` and `Z` are `Params` and `State` whose leaves are indices: `p[P.car.mu]` and
`z[Z.clock.tick]` are numbers, `read(z, Z.motion)` is a Motion.
"""

from typing import Annotated, Any, NamedTuple

from ..backend.arrays import offsets
from ..record import PACKET_WIDTH
from ..scenarios.driver import Driver
from ..scenarios.roads import Lead
from ..scenarios.speed import Pace
from ..scenarios.steering import STEERING_WIDTH
from ..scenarios.tracks import Path
from ..scenarios.wind import Wind
from ..sensors.camera import View
from ..sensors.gps import Sky
from ..sensors.link import IN_FLIGHT, Link
from ..sensors.noise import Noise
from ..sensors.slow import SLOW, VALUES
from ..task.reference import Target
from ..vehicle.actuators import Lag
from ..vehicle.dynamics import Car, Motion, Road
from ..vehicle.linear import Bicycle


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
    """Integers of an episode, as floats."""

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
    values: Annotated[tuple[Any, ...], VALUES]
    arrived: Any  # tick of its delivery
    drift: Any  # what the sensor carries from sample to sample


IN_SLOW, SLOW_WIDTH = offsets(Slow)


class Params(NamedTuple):
    """Parameters, constant within an episode. New parts go at the end."""

    car: Car
    road: Road
    motor: Lag
    steering: Lag
    wind: Wind
    pace: Pace
    noise: Noise
    slow: Annotated[tuple[Link, ...], len(SLOW)]
    target: Target
    disturbance: Disturbance
    task: Task
    programme: Annotated[tuple[Any, ...], STEERING_WIDTH]
    sky: Sky  # of the GPS
    driver: Driver
    path: Path
    change: Change
    sight: View  # of the camera
    leader: Bicycle  # nominal, which lays the road


class State(NamedTuple):
    """The state, which changes from tick to tick. A new part goes at the end or, where a tick of
    the plant changes it, before `slow`."""

    motion: Motion
    drive: Drive
    clock: Clock
    refs: Annotated[tuple[Any, ...], 2]  # rad, rad/s, the references of beta and gamma
    lead: Lead  # the nominal car where it lays the road
    slow: Annotated[tuple[Slow, ...], len(SLOW)]
    queue: Annotated[Any, len(SLOW) * IN_FLIGHT * PACKET_WIDTH]  # packets, columns as in `Packet`
    driver: Any  # rad, the driver's steering command
    under_way: Any  # how many packets are in the queue


P, PARAMS_WIDTH = offsets(Params)
Z, STATE_WIDTH = offsets(State)


class Switches(NamedTuple):
    """Integers that choose the text of the plant and the task, the same for a whole batch."""

    small_angle: int
    law: int
    reference: int
    steering: int  # kind of steering programme, used at reset
    all_samples: int  # the observation holds every fast sample
    with_map: int  # and the road's curvature
    fail_bad: int  # a non-finite action ends the episode instead of being refused
    roll: int  # the body rolls
    road: int  # of `scenarios.roads.ROADS`


FLAGS, _ = offsets(Switches)
