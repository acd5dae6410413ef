"""Loops of a PI on the sideslip angle, opened at the plant's input: tie-vision's Table II.

The table gives two gain margins, 5.92 dB at 15.15 Hz (half of 1 / 33 ms) and 22.8 dB at 477.46 Hz
(3000 rad/s, probably where a frequency grid ended), for closed-loop poles "at -2 Hz", and nothing
else: no speed, no Q and R, no discretisation. `search` tries what it leaves open.
"""

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import solve_discrete_are

from ....agents.controllers.two_dof import CAMERA_PERIOD
from ....agents.design.pi import PI, PLACEMENTS, POLE, design_pi
from ....envs.record import Array
from ....envs.scenarios.draws import KMH
from ....envs.ticks import TICK
from ....envs.vehicle.linear import make_bicycle_model, make_vision_model
from ....envs.vehicle.vehicle import Vehicle
from ....estimators.design.kalman import kalman_gain
from .margins import compute_gain_margin

if TYPE_CHECKING:
    from control import StateSpace

Parts = tuple[Array, Array, Array, Array]

PRINTED = (5.92, 22.8)  # dB, single-rate and multirate: Table II of tie-vision
SENSORS = ("gyro", "vision", "vision-delayed")
INTEGRALS = {"forward-euler": 0.0, "tustin": 0.5, "backward-euler": 1.0}  # share of this sample


@dataclass(frozen=True)
class LoopDesign:
    """The choices that Table II leaves open.

    speed: m/s. placement, pole: of `design_pi`. integral: of `INTEGRALS`. sensors: what the Kalman
    filter measures in every step: the yaw rate; with psi and y_l; these one step late, (12)-(13).
    q_ratio: process variance of beta over that of gamma (and of psi and y_l, which have gamma's).
    noise: variance of every measurement over gamma's process variance.
    """

    speed: float = 25.0 * KMH
    placement: str = "real"
    pole: float = POLE
    integral: str = "forward-euler"
    sensors: str = "gyro"
    q_ratio: float = 25.75
    noise: float = 1e-9


def _compute_direct_gain(pi: PI, dt: float, integral: str) -> float:
    """The PI's direct gain; its sum grows by k_i dt error in all three forms."""
    return pi.k_p + INTEGRALS[integral] * pi.k_i * dt


def make_plain_loop(vehicle: Vehicle, design: LoopDesign, dt: float) -> "StateSpace":
    """PI and plant with beta measured without delay; yaw moment held over dt seconds."""
    import control

    pi = _pi(vehicle, design.speed, design.pole, design.placement)
    G, H = make_bicycle_model(vehicle, design.speed).discretise(dt)
    plant = control.StateSpace(G, H[:, 1:], [[1.0, 0.0]], 0.0, dt)
    direct = _compute_direct_gain(pi, dt, design.integral)
    return plant * control.StateSpace(1.0, pi.k_i * dt, 1.0, direct, dt)


@lru_cache(maxsize=1024)
def _make_filter(
    vehicle: Vehicle, speed: float, sensors: str, q_ratio: float, noise: float, dt: float
) -> tuple[Array, Array, Array, Array]:
    """(G, H, C, K): from the yaw moment to what the filter measures, and its steady gain."""
    model = (make_bicycle_model if sensors == "gyro" else make_vision_model)(vehicle, speed)
    G, H = model.discretise(dt)
    H, C = H[:, 1:2], model.C
    if sensors == "vision-delayed":
        G = np.block([[G, np.zeros((4, 2))], [np.eye(6)[2:4]]])  # tie-vision (12)
        H = np.vstack([H, np.zeros((2, 1))])
        C = np.eye(6)[[1, 4, 5]]  # tie-vision (13)
    Q = np.zeros_like(G)
    driven = min(len(G), 4)  # what (12) only remembers is not driven
    Q[range(driven), range(driven)] = [q_ratio, 1.0, 1.0, 1.0][:driven]
    R = noise * np.eye(len(C))
    return G, H, C, kalman_gain(solve_discrete_are(G.T, C.T, Q, R), C, R)


_pi = lru_cache(maxsize=256)(design_pi)


def _split_loop(vehicle: Vehicle, design: LoopDesign, dt: float) -> tuple[Parts, Parts]:
    """(A, B, C, D) of the plant and, with the sign of negative feedback, of filter and PI."""
    pi = _pi(vehicle, design.speed, design.pole, design.placement)
    G, H, C, K = _make_filter(
        vehicle, design.speed, design.sensors, design.q_ratio, design.noise, dt
    )
    F, direct = np.eye(len(G)) - K @ C, _compute_direct_gain(pi, dt, design.integral)
    beta_x, beta_y = F[:1], K[:1]  # the estimate of beta from the prediction and from y
    one = np.ones((1, 1))
    A = np.block([[G @ F - direct * H @ beta_x, H], [-pi.k_i * dt * beta_x, one]])
    B = np.vstack([G @ K - direct * H @ beta_y, -pi.k_i * dt * beta_y])
    return (
        (G, H, C, np.zeros((len(C), 1))),
        (A, B, np.hstack([direct * beta_x, -one]), direct * beta_y),
    )


def make_estimator_loop(vehicle: Vehicle, design: LoopDesign, dt: float) -> "StateSpace":
    """Plant, Kalman filter and PI, opened where the yaw moment enters the plant.

    The filter's input is the moment that the PI asks for: opened behind both, a filter with the
    right model would not show in the loop at all. It has its steady gain and the PI reads the
    estimate after the correction.
    """
    import control

    plant, asks = _split_loop(vehicle, design, dt)
    return control.StateSpace(*asks, dt) * control.StateSpace(*plant, dt)


def _evaluate_nyquist(parts: tuple[Parts, Parts]) -> float:
    """The loop at z = -1, where it is real."""
    value = np.eye(1)
    for A, B, C, D in parts:
        value = (D - C @ np.linalg.solve(np.eye(len(A)) + A, B)) @ value
    return float(value[0, 0])


def compute_margins(vehicle: Vehicle, design: LoopDesign) -> list[tuple[float, float]]:
    """Gain margins (dB, rad/s) of the loop at the camera's 33 ms and at 1 ms, the same PI and
    variances in both."""
    return [
        compute_gain_margin(make_estimator_loop(vehicle, design, dt))
        for dt in (CAMERA_PERIOD, TICK)
    ]


GRID: dict[str, tuple[float | str, ...]] = {
    "speed": tuple(kmh * KMH for kmh in (10.0, 14.0, 20.0, 25.0, 30.0)),
    "placement": PLACEMENTS,
    "integral": tuple(INTEGRALS),
    "sensors": SENSORS,
    "q_ratio": tuple(float(10.0**power) for power in np.arange(-1.0, 4.01, 0.1)),
}


@dataclass(frozen=True)
class LoopMatch:
    """A design and its two margins in dB, single-rate and multirate."""

    design: LoopDesign
    decibels: tuple[float, float]

    @property
    def off(self) -> float:
        """The larger difference to the printed margins, in dB."""
        return max(abs(a - b) for a, b in zip(self.decibels, PRINTED, strict=True))


def search(vehicle: Vehicle, within: float = 0.5) -> list[LoopMatch]:
    """The designs of `GRID` whose margins both lie within some dB of Table II, the best first.

    Both crossovers are at half the sampling rate and the closed loops are stable, as in the paper.
    """
    hits = []
    for values in itertools.product(*GRID.values()):
        options: dict[str, Any] = dict(zip(GRID, values, strict=True))
        design, margins = LoopDesign(**options), []
        for dt, printed in zip((CAMERA_PERIOD, TICK), PRINTED, strict=True):
            end = _evaluate_nyquist(
                _split_loop(vehicle, design, dt)
            )  # a screen, before all crossings
            if end >= 0.0 or abs(-20.0 * math.log10(-end) - printed) > within:
                break
            loop = make_estimator_loop(vehicle, design, dt)
            decibels, omega = compute_gain_margin(loop)
            if abs(omega * dt - math.pi) > 1e-9 or not _is_stable(loop):
                break
            margins.append(decibels)
        if len(margins) == len(PRINTED):
            hits.append(LoopMatch(design, (margins[0], margins[1])))
    return sorted(hits, key=lambda hit: hit.off)


def _is_stable(loop: "StateSpace") -> bool:
    import control

    return bool(np.abs(control.feedback(loop, 1).poles()).max() < 1.0)
