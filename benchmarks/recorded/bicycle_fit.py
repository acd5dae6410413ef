"""The plant's parameters from recorded drives: least squares over windows, jackknife intervals.

In a window the plant's own single-track model drives at the logged speed with the logged steering;
its first second, in which the unknown start is forgotten, does not count.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter1d
from scipy.optimize import least_squares
from scipy.stats import t as student

from ...envs.engine.config import make_car
from ...envs.numerics.jit import jit
from ...envs.record import FAST, MOVING_SPEED, PACKET, Array, Log
from ...envs.vehicle import dynamics
from ...envs.vehicle.dynamics import CarParams, Motion
from ...envs.vehicle.parameters import GRAVITY, Vehicle
from ...envs.vehicle.tyres import (
    FIALA,
    LINEAR,
    TYRE_LAWS,
    PlantVariant,
    TyreInputs,
    compute_tyre_load,
)
from .quality import find_saturated

_STEP, _SMOOTH = 0.01, 0.03  # s: of the fit's grid, of the mean over a log's rows
_BURN, _WINDOW, _MARGIN = 1.0, 4.0, 0.3  # s: forgets the start, counts, lets channels be late
_REACH = _BURN + _WINDOW + 2.0 * _MARGIN  # s, of the rows from a window's start on
_ALIKE = (0.0, 0.1, 0.25, 0.5, 1.0)  # s, for which rows of a residual may be alike
_STRETCHES = 40  # at most, of the log, which the intervals take for independent


class Theta(NamedTuple):
    """Fitted parameters; the first three are logarithms of factors on the stated car."""

    front: float = 0.0
    rear: float = 0.0
    inertia: float = 0.0
    gain: float = 1.0  # rad at the wheels per unit of logged steering
    offset: float = 0.0  # rad at the wheels, added
    gyro_bias: float = 0.0  # rad/s
    accel_bias: float = 0.0  # m/s2
    accel_gain: float = 1.0  # above 1 where the body rolls more than the stated one
    steer_delay: float = 0.0  # s that the logged steering is later than the gyro
    accel_delay: float = 0.0  # s
    gps_delay: float = 0.0  # s


_STEPS = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1e-4, 1e-4, 1e-3, 1e-3, 4e-3, 4e-3, 4e-3])  # of slopes
_LOW = np.array([-2.0, -2.0, -2.0, -np.inf, -0.5, -0.5, -5.0, 0.3, -_MARGIN, -_MARGIN, -_MARGIN])
_HIGH = np.array([2.0, 2.0, 2.0, np.inf, 0.5, 0.5, 5.0, 3.0, _MARGIN, _MARGIN, _BURN])
_STATED = Theta()
PRIOR = Theta(0.4, 0.4, 0.2, 0.05, 0.01, 0.01, 0.5, 0.1, 0.1, 0.1, 0.3)
"""Standard deviations of the priors around the stated values; of the gain a fraction. That of the
inertia, one of I/(m l_f l_r), is narrow: with both stiffnesses it leaves the yaw rate as it is."""


@jit
def _compute_load(rows: Any, i: Any, place: Any, theta: Any, car: Any) -> Any:
    """The plant's load in row i with the steering logged at a place between the rows."""
    j = min(max(int(np.floor(place)), 0), rows.shape[1] - 2)
    logged = rows[3, j] + (place - j) * (rows[3, j + 1] - rows[3, j])
    inputs = TyreInputs(theta[3] * logged + theta[4], rows[4, i], rows[5, i])
    return compute_tyre_load(inputs, car, PlantVariant(0, FIALA, 1))  # no limit of drive force


@jit
def _simulate_windows(
    rows: Any, starts: Any, theta: Any, car: CarParams, law: int, h: float, out: Any
) -> None:
    """Fill out (3, windows, rows): yaw rate, lateral specific force, sideslip angle of the GPS."""
    inertia = (car.I * np.exp(theta[2]),)
    tyres = car.C_f * np.exp(theta[0]), car.C_r * np.exp(theta[1])
    car = CarParams(*(car[:1] + inertia + car[2:4] + tyres + car[6:]))  # I is field 1, C_f 4, C_r 5
    road = dynamics.RoadParams(0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    push = dynamics.DisturbanceForces(0.0, 0.0, 0.0)
    variant = PlantVariant(0, law, int(law != LINEAR))
    for w in range(len(starts)):
        at = starts[w]
        V, gamma = rows[2, at], rows[0, at] - theta[5]
        v_y = car.l_r * gamma
        v_y -= car.m * car.l_f * V * V * gamma / (2.0 * car.C_r * (car.l_f + car.l_r))
        phi = phi_dot = 0.0
        after = _compute_load(rows, at, at + 0.5 + theta[8] / h, theta, car)
        for k in range(out.shape[2]):
            i = at + k + 1
            V = 0.5 * (rows[2, i - 1] + rows[2, i])
            late = i + theta[8] / h  # a row's steering is that of the middle of its step
            before, after = after, _compute_load(rows, i, late + 0.5, theta, car)
            loads = (before, _compute_load(rows, i, late, theta, car), after)
            motion = Motion(V, v_y, gamma, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, phi, phi_dot, 0.0, 0.0)
            motion = dynamics.rk4(motion, loads, push, car, road, h, variant)
            v_y, gamma, phi, phi_dot = motion.v_y, motion.gamma, motion.phi, motion.phi_dot
            motion = Motion(V, v_y, gamma, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, phi, phi_dot, 0.0, 0.0)
            slope = dynamics.derivative(motion, after, push, car, road, variant)
            out[0, w, k], out[1, w, k] = gamma, slope.v_y + V * gamma + GRAVITY * phi
            out[2, w, k] = np.arctan2(v_y + car.forward * gamma, V)


def _compute_courses(log: Log, every: int, count: int) -> Array:
    """The GPS's course less the gyro's integral (rad), NaN in rows without a fix, (count,)."""
    courses = np.full(count, np.nan)
    packets = log.record.select_packets("gps")
    fixes = packets[(packets[:, PACKET.quality] > 0.0) & np.isfinite(packets[:, PACKET.value])]
    places = fixes[:, PACKET.captured] - log.record.first
    turned = np.interp(places, np.arange(len(log.time)), log.heading)
    near = np.clip(np.rint(places / every).astype(np.int64), 0, count - 1)
    courses[near] = np.unwrap(fixes[:, PACKET.value] - turned)
    return courses


@dataclass(frozen=True)
class Windows:
    """A stated car's drives on the fit's grid and where windows start on it."""

    car: Vehicle
    # smoothed gyro, accel_y, speed, steering, left and right torque (these three acted until their
    # row), the integral of the gyro, the GPS's course less that, NaN without a fix: shape (8, n)
    rows: Array
    starts: npt.NDArray[np.int64]  # first row of each window, shape (count,)
    stretch: npt.NDArray[np.int64]  # stretch of the log of each window, shape (count,)
    dt: float  # step (s)
    accel: bool  # whether the acceleration was logged
    course: bool = False  # whether a window has fixes
    tyres: str = "linear"  # law in `TYRE_LAWS`; the body rolls where they are not linear
    centre: Theta = _STATED  # means of the priors
    spread: Theta = PRIOR  # standard deviations of the priors

    @classmethod
    def from_logs(cls, logs: Sequence[Log], car: Vehicle) -> "Windows":
        """Make windows of drives of one dt, without rows in which the gyro is at its limit."""
        dt, first, pieces, starts = logs[0].record.dt, 0, [], []
        every, width = max(round(_STEP / dt), 1), max(round(_SMOOTH / dt), 1)
        before, after = (round(seconds / (every * dt)) for seconds in (_MARGIN, _REACH))
        for log in logs:
            fast = log.record.fast.T
            rows = np.stack([
                fast[FAST.gyro], fast[FAST.accel_y], log.speed, fast[FAST.steer],
                fast[FAST.torque_left], fast[FAST.torque_right], log.heading,
                np.zeros(len(log.time)),
            ])  # fmt: skip
            rows = uniform_filter1d(rows, width, axis=1, mode="nearest")
            if every > 1:  # an input acts for the whole step up to its row
                rows[3:6] = uniform_filter1d(rows[3:6], every, axis=1, origin=(every - 1) // 2)
            bad = np.maximum.reduceat(find_saturated(log), np.arange(0, len(log.time), every))
            rows = rows[:, ::every]
            rows[7] = _compute_courses(log, every, rows.shape[1])
            for start in range(before, rows.shape[1] - after, round(_WINDOW / (every * dt))):
                piece = slice(start, start + after)
                if not bad[piece].any() and rows[2, piece].min() >= MOVING_SPEED:
                    starts.append(first + start)
            first += rows.shape[1]
            pieces.append(rows)
        count = len(starts)
        stretch = np.arange(count) * min(_STRETCHES, count) // max(count, 1)
        accel = all("accel_y" in log.record.present for log in logs)
        rows = np.ascontiguousarray(np.concatenate(pieces, axis=1))
        windows = cls(car, rows, np.array(starts, np.int64), stretch, every * dt, accel)
        return replace(windows, course=bool(np.isfinite(rows[7][windows.scored_rows]).any()))

    @property
    def scored_rows(self) -> npt.NDArray[np.int64]:
        """Places of the rows that count, shape (count, rows)."""
        first, count = round(_BURN / self.dt), round(_WINDOW / self.dt)
        return self.starts[:, None] + np.arange(first + 1, first + count + 1)

    def simulate(self, theta: Theta) -> Array:
        """Drive the model through each window with the logged speed and steering.

        Args:
            theta: Parameters.

        Returns:
            Yaw rate (rad/s), lateral specific force (m/s2) and sideslip angle of the antenna (rad)
            from the row behind each start on, shape (3, windows, rows).
        """
        rows = sum(round(seconds / self.dt) for seconds in (_BURN, _WINDOW, _MARGIN))
        out = np.empty((3, len(self.starts), rows))
        static = self.car.replace(transfer_height=0.0, relaxation=0.0)  # no load moves, no lag
        car, law = CarParams(*map(float, make_car(static))), TYRE_LAWS.index(self.tyres)
        _simulate_windows(self.rows, self.starts, np.array(theta), car, law, self.dt, out)
        return out

    def compute_residual(self, theta: Theta) -> Array:
        """Compute measured less predicted channels.

        Args:
            theta: Parameters.

        Returns:
            Yaw rate (rad/s) and, if logged, acceleration (m/s2) and course (rad), which begins anew
            in each window and is 0 in rows without a fix, shape (windows, channels, rows).
        """
        first, count = round(_BURN / self.dt), round(_WINDOW / self.dt)
        out, places = self.simulate(theta), self.scored_rows

        def interpolate_late(values: Array, delay: float) -> Array:
            late = np.arange(first, first + count) - delay / self.dt
            below = np.clip(late.astype(np.int64), 0, out.shape[2] - 2)
            step = values[:, below + 1] - values[:, below]
            return np.asarray(values[:, below] + (late - below) * step)

        rate = self.rows[0][places] - out[0, :, first : first + count] - theta.gyro_bias
        channels = [rate]
        if self.accel:
            felt = theta.accel_gain * interpolate_late(out[1], theta.accel_delay) + theta.accel_bias
            channels.append(self.rows[1][places] - felt)
        if self.course:
            turned = self.rows[6][self.starts[:, None] + np.arange(1, out.shape[2] + 1)]
            moved = out[2] + turned - theta.gyro_bias * self.dt * np.arange(out.shape[2])
            course = self.rows[7][places] + self.rows[6][places]
            course = course - interpolate_late(moved, theta.gps_delay)
            fixes = np.isfinite(course)
            course = np.where(fixes, course, 0.0)
            middle = course.sum(axis=1) / np.maximum(fixes.sum(axis=1), 1)
            channels.append(np.where(fixes, course - middle[:, None], 0.0))
        return np.stack(channels, axis=1)


@dataclass(frozen=True)
class BicycleFit:
    """A fitted `Theta`, its n free parameters, and every stretch's normal equations there."""

    theta: Theta  # fitted parameters
    free: tuple[str, ...]  # names of the free ones
    scale: Array  # standard deviations of the channels' residuals, by which the fit is weighted
    H: Array  # curvature of each stretch's squares, shape (stretches, n, n)
    g: Array  # slope of each stretch's squares, shape (stretches, n)
    prior: Array  # curvature of the priors, which belong to no stretch, shape (n,)
    pull: Array  # slope of the priors, shape (n,)

    def estimate_shift(self, left_out: npt.NDArray[np.bool_]) -> Array:
        """Estimate to first order how the parameters, (n,), move without some stretches.

        Args:
            left_out: Mask, shape (stretches,).
        """
        rest = self.H[~left_out].sum(axis=0) + np.diag(self.prior)
        return np.asarray(-np.linalg.solve(rest, self.g[~left_out].sum(axis=0) + self.pull))

    @cached_property
    def halves(self) -> dict[str, float]:
        """Halves of the free parameters' 95 % intervals: a jackknife, and the priors' part."""
        count, inverse = len(self.g), np.linalg.inv(self.H.sum(axis=0) + np.diag(self.prior))
        moves = np.array([self.estimate_shift(one) for one in np.eye(count, dtype=bool)])
        variances = [
            (count - 1) / count * np.sum(move**2) + pulled**2 @ self.prior
            for move, pulled in zip(moves.T, inverse, strict=True)
        ]
        reach = student.ppf(0.975, count - 1)
        return {x: float(reach * np.sqrt(v)) for x, v in zip(self.free, variances, strict=True)}


def _estimate_noise_levels(left: Array, dt: float) -> Array:
    """Estimate deviations of independent rows that tell as much as a residual's, (channels,).

    Rows of a residual are alike for a while: means over up to 1 s, by the root of their rows.
    """
    levels = [np.full(left.shape[1], 1e-9)]
    shown = np.maximum(np.mean(left != 0.0, axis=(0, 2)), 1e-9)
    for seconds in _ALIKE:
        rows = max(round(seconds / dt), 1)
        trimmed = left[:, :, : left.shape[2] // rows * rows]
        means = trimmed.reshape(*left.shape[:2], -1, rows).mean(axis=3)
        levels.append(np.sqrt(rows * np.mean(means**2, axis=(0, 2)) / shown))
    return np.asarray(np.max(levels, axis=0))


def fit(w: Windows, start: Theta, free: Sequence[str], scale: Array | None = None) -> BicycleFit:
    """Fit parameters by least squares.

    Args:
        w: Windows.
        start: Parameters where the search starts.
        free: Names of those that are fitted.
        scale: Standard deviations of the channels' residuals; None: estimated.
    """
    at = [Theta._fields.index(name) for name in free]
    low, high, centre, sd = _LOW[at], _HIGH[at], np.array(w.centre)[at], np.array(w.spread)[at]
    steps = (_STEPS * (1, 1, 1, abs(start.gain), *7 * (1,)))[at]

    def make_theta(x: Array) -> Theta:
        return start._replace(**dict(zip(free, x.tolist(), strict=True)))

    def compute_weighted(x: Array, scale: Array) -> Array:
        left = w.compute_residual(make_theta(x)) / scale[:, None]
        return np.concatenate([left.ravel(), (x - centre) / sd])

    def jacobian(x: Array, scale: Array) -> Array:
        shifted = np.array([compute_weighted(point, scale) for point in x + np.diag(steps)])
        return np.asarray(((shifted - compute_weighted(x, scale)) / steps[:, None]).T)

    x = np.clip(np.array(start)[at], low, high)
    for max_evaluations in (60,) if scale is not None else (10, 10, 60):
        now = scale
        if now is None:
            now = _estimate_noise_levels(w.compute_residual(make_theta(x)), w.dt)
        solution = least_squares(
            compute_weighted, x, jacobian, (low, high), x_scale=10.0 * steps, args=(now,),
            max_nfev=max_evaluations, xtol=1e-6, ftol=1e-7,
        )  # fmt: skip
        x = solution.x
    flat = (part[: -len(at)] for part in (solution.jac, solution.fun))  # without the priors' rows
    J, r = (part.reshape(len(w.starts), -1, *part.shape[1:]) for part in flat)
    membership = (w.stretch[:, None] == np.unique(w.stretch)).astype(float)  # (windows, stretches)
    H = np.einsum("ws,wki,wkj->sij", membership, J, J, optimize=True)
    g = np.einsum("ws,wki,wk->si", membership, J, r, optimize=True)
    assert now is not None
    return BicycleFit(make_theta(x), tuple(free), now, H, g, sd**-2.0, (x - centre) / sd**2)
