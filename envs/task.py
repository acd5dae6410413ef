"""The task: references, cost rate, failures, and the contents of `info` and observations."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from .numerics.functions import TICK
from .numerics.jit import jit
from .numerics.primitives import Scalar, Vector, absolute, maximum, minimum, select
from .record import FAST, FAST_UNITS, Array
from .sensors.slow import SLOW
from .vehicle.actuators import apply_lag
from .vehicle.parameters import GRAVITY, Vehicle

Infos = dict[str, Any]
"""An env's `info`, or a vector env's `infos`."""

REFERENCES = ("zero-slip", "model", "limited", "lagged")
ZERO_SLIP, MODEL, LIMITED, LAGGED = range(len(REFERENCES))

# The lagged reference understeers with a characteristic speed of at most 35 m/s (the passenger car
# has 36.5). Its lag is about that of both presets, two over the trace of their lateral dynamics:
# 0.08 s for the COMS at 22 km/h, 0.12 s for the passenger car at 70 km/h.
_CHARACTERISTIC_SPEED = 35.0  # m/s
REFERENCE_LAG = 0.1  # s


class ReferenceParams(NamedTuple):
    """Coefficients of the steady-state responses of the nominal vehicle."""

    b_0: Scalar  # l_r / l
    b_1: Scalar  # s2/m2, M l_f / (2 l C_r l_r)
    G: Scalar  # s2/m2, stability factor, dakf-stability (24)
    per_l: Scalar  # 1/m, 1 / l
    mu_g: Scalar  # m/s2, mu g
    G_lagged: Scalar  # s2/m2, stability factor of the lagged reference
    rest: Scalar  # fraction of its deviation from the steady state that remains after a tick


def make_reference_params(nominal: Vehicle) -> ReferenceParams:
    """Compute the coefficients of the references for a nominal vehicle.

    Args:
        nominal: The nominal vehicle.
    """
    l, M = nominal.wheelbase, nominal.mass  # noqa: E741
    C_f, C_r = nominal.front_stiffness, nominal.rear_stiffness
    l_f, l_r = nominal.front_arm, nominal.rear_arm
    G = M / (2.0 * l * l) * (C_r * l_r - C_f * l_f) / (C_f * C_r)  # dakf-stability (24)
    return ReferenceParams(
        l_r / l, M * l_f / (2.0 * l * C_r * l_r), G, 1.0 / l, nominal.friction * GRAVITY,
        max(G, _CHARACTERISTIC_SPEED**-2), math.exp(-TICK / REFERENCE_LAG),
    )  # fmt: skip


@jit
def compute_reference(steer: Scalar, v: Scalar, target: ReferenceParams, reference: int) -> Vector:
    """Compute the steady-state beta_ref (rad) and gamma_ref (rad/s) of a command at a speed.

    zero-slip: (0, 0), the yaw rate is not judged. model: the nominal steady state, with
    1 + G v^2 at least 0.2. limited: the model with |gamma| <= 0.85 mu g / v and
    |beta| <= 0.02 mu g (Rajamani, Vehicle Dynamics and Control). lagged: limited, with the
    stability factor of a car that understeers, for `filter_reference`.

    Args:
        steer: The driver's steering command (rad).
        v: Measured speed (m/s).
        target: `ReferenceParams`.
        reference: Place of the reference in `REFERENCES`.
    """
    if reference == ZERO_SLIP:
        return 0.0 * steer, 0.0 * steer
    G = target.G_lagged if reference == LAGGED else target.G
    gain = steer / maximum(1.0 + G * v * v, 0.2)
    beta = (1.0 - target.b_1 * v * v) * target.b_0 * gain  # dakf-stability (23)
    gamma = v * target.per_l * gain  # dakf-stability (23)
    if reference in (LIMITED, LAGGED):
        max_beta, max_gamma = 0.02 * target.mu_g, 0.85 * target.mu_g / maximum(v, 1.0)
        beta = minimum(maximum(beta, 0.0 - max_beta), max_beta)
        gamma = minimum(maximum(gamma, 0.0 - max_gamma), max_gamma)
    return beta, gamma


@jit
def filter_reference(
    before: Vector, steady: Vector, target: ReferenceParams, reference: int
) -> Vector:
    """Filter the reference (rad, rad/s) over a tick: the lagged one approaches, the others jump.

    Args:
        before: (beta_ref, gamma_ref) of the tick before (rad, rad/s).
        steady: Result of `compute_reference` (rad, rad/s).
        target: `ReferenceParams`.
        reference: Place of the reference in `REFERENCES`.
    """
    if reference == LAGGED:
        rest = target.rest
        return apply_lag(steady[0], before[0], rest), apply_lag(steady[1], before[1], rest)
    return steady


BETA_SCALE, GAMMA_SCALE, STEER_SCALE = 0.02, 0.1, 0.05  # rad, rad/s, rad
EFFORT_WEIGHT, COST_CAP = 0.01, 100.0  # 1/s both
RATE_TICKS = 10  # over which the yaw moment's rate is taken


@jit
def compute_cost_rate(
    e_beta: Scalar, e_gamma: Scalar, moment_share: Scalar, steer_added: Scalar, reference: int,
    moment_rate: Scalar = 0.0,
) -> Scalar:  # fmt: skip
    """Compute the cost rate of a tick (1/s), capped at 100.

    c = (e_beta/0.02)^2 + (e_gamma/0.1)^2 + 0.01 (N_z/N_max)^2 + 0.01 (added steering/0.05)^2,
    angles in rad and rates in rad/s, and what the moment's rate costs.

    Args:
        e_beta: Error of the sideslip angle (rad).
        e_gamma: Error of the yaw rate (rad/s), not judged with "zero-slip".
        moment_share: Yaw moment as a fraction of its full scale.
        steer_added: Added steering angle (rad).
        reference: Place of the reference in `REFERENCES`.
        moment_rate: Cost rate of the yaw moment's rate (1/s).
    """
    b, s = e_beta * (1.0 / BETA_SCALE), steer_added * (1.0 / STEER_SCALE)
    c = b * b + EFFORT_WEIGHT * (moment_share * moment_share) + EFFORT_WEIGHT * (s * s)
    c = c + moment_rate
    if reference != ZERO_SLIP:
        g = e_gamma * (1.0 / GAMMA_SCALE)
        c = c + g * g
    return minimum(absolute(c), COST_CAP)


@jit
def compute_failure_cost(duration: Scalar, tick: Scalar) -> Scalar:
    """Compute the cost of the rest of a failed episode, so that failing never pays.

    Args:
        duration: Length of the episode (ticks).
        tick: Tick at which it failed.
    """
    return COST_CAP * (duration - tick) * TICK


RUNNING, SPIN, OFF_ROAD, NOT_FINITE, BAD_ACTION, COLLISION, DEPARTURE = range(7)
FAILURES = ("none", "spin", "off-road", "not-finite", "bad-action", "collision", "departure")
REFUSED = -1  # result of a step whose action is refused
WILD = 1 << 30  # added to the result of a step where an action was beyond `WILD_LIMIT`
WILD_LIMIT = 10.0  # fraction of full scale beyond which an action is a mistake


@jit
def select_failure(lost: Scalar, spun: Scalar, off: Scalar) -> Scalar:
    """Select the failure's code, a float: the first that applies, in this order.

    Args:
        lost: Whether the numbers are no longer finite.
        spun: Whether the car spins.
        off: Whether it has left the road.
    """
    failure = select(spun, SPIN * 1.0, select(off, OFF_ROAD * 1.0, RUNNING * 1.0))
    return select(lost, NOT_FINITE * 1.0, failure)


class StepReport(NamedTuple):
    """Columns of the report of a step, from which `info` is made."""

    t: int = 0  # s
    beta: int = 1  # rad
    gamma: int = 2  # rad/s
    psi: int = 3  # rad
    beta_ref: int = 4  # rad
    gamma_ref: int = 5  # rad/s
    steer: int = 6  # rad, front wheels
    yaw_moment: int = 7  # N m, of both motors
    cost: int = 8  # of the step
    failure: int = 9  # place in `FAILURES`
    packets: int = 10  # how many were delivered
    reward: int = 11
    ended: int = 12  # 1: the time is over


REPORT = StepReport()

_NUMBERS = REPORT._fields[: REPORT.failure]  # first keys of `info`, all floats
_KEYS = (*_NUMBERS, "failure", "is_success")
_RUNNING: Infos = dict.fromkeys(_NUMBERS, 0.0) | {"failure": RUNNING, "is_success": False}
_MASKS = tuple(f"_{key}" for key in _KEYS)


def make_info(report: list[float]) -> Infos:
    """Make `info` of a step or a reset.

    Args:
        report: Report of the step, a number for each column of `StepReport`.
    """
    info = _RUNNING.copy()  # a copy's keys need no sorting in
    (
        info["t"], info["beta"], info["gamma"], info["psi"], info["beta_ref"], info["gamma_ref"],
        info["steer"], info["yaw_moment"], info["cost"], code, _, _, ended,
    ) = report  # fmt: skip
    if code != RUNNING:
        info["failure"] = int(code)
    elif ended == 1.0:
        info["is_success"] = True
    return info


def make_infos(reports: Array, rows: npt.NDArray[np.bool_]) -> Infos:
    """Make infos of a batch's rows as Gymnasium has them: arrays (N,) and, under `_key`, masks.

    Args:
        reports: Reports, shape (N, len(StepReport)).
        rows: Rows that are reported, shape (N,); the others have zeros.
    """
    columns = np.where(rows[:, None], reports, 0.0).T.copy()  # each key contiguous
    failure = columns[REPORT.failure].astype(np.int64)
    success = (columns[REPORT.ended] == 1.0) & (failure == RUNNING)
    values = (*columns[: len(_NUMBERS)], failure, success)
    masks = np.tile(rows, (len(values), 1))
    return dict(zip((*_KEYS, *_MASKS), (*values, *masks), strict=True))


class ObservationEntry(NamedTuple):
    """One number of an observation.

    Attributes:
        name: Name of the entry.
        unit: Its unit.
        low: Lower bound, finite.
        high: Upper bound, finite.
    """

    name: str
    unit: str
    low: float
    high: float


OBSERVATION_OPTIONS = ("fast", "with_map")  # they change the observation, and nothing of a drive
N_SAMPLED = 6  # the first columns of a fast row are sensors; the policy sees last and mean of each
AGE_CAP = 10.0  # s

_FAST_BOUNDS = (10.0, 50.0, 50.0, 10.0, 100.0, 100.0, 1.0, 2000.0, 2000.0, 1.0, 50.0, 1.0)
_LAST_ONLY = ("steer", "torque_left", "torque_right", "steer_command")  # seen as they were last


def make_space(layout: Sequence[ObservationEntry], frames: int = 1) -> "gym.spaces.Box[np.float32]":
    """Make the box, shape (len(layout) * frames,), of an observation or of a stack of frames.

    Args:
        layout: Entries of the observation.
        frames: Number of frames in the stack.
    """
    low, high = np.array([entry[2:] for entry in layout]).T.astype(np.float32)
    return gym.spaces.Box(np.repeat(low, frames), np.repeat(high, frames), dtype=np.float32)


def make_observation_layout(
    slow: tuple[str, ...], n: int, fast: str, with_map: bool = False
) -> tuple[ObservationEntry, ...]:
    """Make the entries of an observation.

    Args:
        slow: Names of the slow sensors present.
        n: Ticks of a control period.
        fast: "summary" (last sample and mean over the step) or "all" (every sample of the step).
        with_map: Whether the road's curvature is an entry.
    """
    entries = []
    for column in range(N_SAMPLED):
        name, unit, bound = FAST._fields[column], FAST_UNITS[column], _FAST_BOUNDS[column]
        names = (name, f"{name}_mean") if fast == "summary" else [f"{name}_{j}" for j in range(n)]
        entries += [ObservationEntry(entry_name, unit, -bound, bound) for entry_name in names]
    for name in (*_LAST_ONLY, "curvature") if with_map else _LAST_ONLY:
        column = getattr(FAST, name)
        bound = _FAST_BOUNDS[column]
        entries.append(ObservationEntry(name, FAST_UNITS[column], -bound, bound))
    for kind in SLOW:
        if kind.name in slow:
            values = [(x.name, x.unit, -x.bound, x.bound) for x in kind.values]
            values += [("age", "s", 0.0, AGE_CAP), ("fresh", "-", 0.0, 1.0)]
            for name, unit, low, high in values:
                entries.append(ObservationEntry(f"{kind.name}_{name}", unit, low, high))
    refs = ("beta_ref", "rad", -1.0, 1.0), ("gamma_ref", "rad/s", -10.0, 10.0)
    return (*entries, *map(ObservationEntry._make, refs))
