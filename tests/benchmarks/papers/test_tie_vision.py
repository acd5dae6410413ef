"""The loops behind Table II, written out another way, their margins, and what the search finds."""

import dataclasses
import math

import control
import numpy as np
import pytest

from sideslip.agents.controllers.two_dof import PLACEMENTS, POLE, design_pi
from sideslip.benchmarks.papers.tie_vision import (
    INTEGRALS,
    PRINTED,
    SENSORS,
    LoopDesign,
    _compute_gain_margin,
    _find_crossings,
    _make_estimator_loop,
    _make_plain_loop,
    _search,
)
from sideslip.envs import COMS
from sideslip.envs.vehicle.linear import make_bicycle_model, make_vision_model
from sideslip.estimators.design.gains import joseph_form, kalman_gain

V = 25.0 / 3.6
DESIGN = LoopDesign()


def test_a_real_pole_is_where_it_was_placed() -> None:
    model, pi = make_bicycle_model(COMS, V), design_pi(COMS, V, POLE, "real")
    plant = control.StateSpace(model.A, model.B[:, 1:], [[1.0, 0.0]], 0.0)
    poles = control.feedback(control.tf([pi.k_p, pi.k_i], [1.0, 0.0]) * plant, 1).poles()
    slow, fast = np.sort(-np.linalg.eigvals(model.A).real)
    assert np.sort(-poles.real) == pytest.approx(np.sort([slow, POLE, fast - POLE]), rel=1e-6)
    assert np.abs(poles.imag).max() < 1e-6


@pytest.mark.parametrize("sensors", SENSORS)
@pytest.mark.parametrize("integral", INTEGRALS)
def test_the_loop_is_what_a_step_by_step_controller_does(sensors: str, integral: str) -> None:
    """An impulse of yaw moment on the plant; the filter's gain from its covariance recursion."""
    design = dataclasses.replace(DESIGN, sensors=sensors, integral=integral, noise=1e-3)
    dt = 0.033
    loop = _make_estimator_loop(design, dt)
    steps = 40
    _, response = control.impulse_response(loop, np.arange(steps) * dt)
    pi = design_pi(COMS, V, POLE, design.placement)

    model = make_bicycle_model(COMS, V) if sensors == "gyro" else make_vision_model(COMS, V)
    G, H = model.discretise(dt)
    n, late = len(G), sensors == "vision-delayed"
    C, Q = model.C, np.diag([design.q_ratio, 1.0, 1.0, 1.0][:n])
    F, measured = G, C
    if late:
        F = np.vstack([np.hstack([G, np.zeros((4, 2))]), np.eye(6)[2:4]])
        measured, Q = np.eye(6)[[1, 4, 5]], np.diag([*np.diag(Q), 0.0, 0.0])
    P, R = np.eye(len(F)), design.noise * np.eye(len(measured))
    for _ in range(3000):
        K = kalman_gain(P, measured, R)
        P = F @ joseph_form(P, K, measured, R) @ F.T + Q
    x, seen, hat, total, out = np.zeros(n), np.zeros(2), np.zeros(len(F)), 0.0, []
    for k in range(steps):
        y = C @ x if not late else np.array([x[1], *seen])
        hat = hat + K @ (y - measured @ hat)
        error, before = -hat[0], total
        total += pi.k_i * dt * error
        used = {"forward-euler": before, "tustin": 0.5 * (before + total), "backward-euler": total}
        asked = pi.k_p * error + used[integral]
        out.append(-asked)
        hat = F @ hat
        hat[:n] += H[:, 1] * asked
        seen = x[2:] if late else seen
        # impulse_response scales the impulse by 1 / dt
        x = G @ x + H[:, 1] * (1.0 / dt if k == 0 else 0.0)
    scale = np.abs(out).max()
    assert np.squeeze(response) == pytest.approx(np.array(out), abs=1e-7 * scale)


def test_a_filter_that_sees_the_true_moment_does_not_show() -> None:
    """Why the loop is opened at the plant only: the plain loop is the limit of a perfect filter."""
    loop = _make_plain_loop(DESIGN, 0.001)
    pi = design_pi(COMS, V, POLE, DESIGN.placement)
    z = np.exp(1j * np.array([1.0, 10.0, 100.0]) * 0.001)
    G, H = make_bicycle_model(COMS, V).discretise(0.001)
    plant = np.array([np.linalg.solve(w * np.eye(2) - G, H[:, 1])[0] for w in z])
    expected = plant * (pi.k_p + pi.k_i * 0.001 / (z - 1.0))
    assert loop(z) == pytest.approx(expected, rel=1e-9)


def test_table_ii_within_half_a_decibel() -> None:
    """Printed are 5.92 and 22.8 dB, both crossovers at half the sampling rate."""
    for printed, dt in zip(PRINTED, (0.033, 0.001), strict=True):
        decibels, omega = _compute_gain_margin(_make_estimator_loop(DESIGN, dt))
        assert decibels == pytest.approx(printed, abs=0.5)
        assert omega == pytest.approx(math.pi / dt, rel=1e-12)


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_the_multirate_loop_has_the_larger_gain_margin_with_the_same_pi(placement: str) -> None:
    """The multirate loop's margin is larger by 20 dB at least."""
    design = dataclasses.replace(DESIGN, placement=placement)
    slow, fast = (_compute_gain_margin(_make_plain_loop(design, dt))[0] for dt in (0.033, 0.001))
    assert fast - slow >= 20.0


@pytest.mark.long
def test_the_search_finds_the_table_at_25_kmh_among_others() -> None:
    hits = _search()
    assert list(hits.values()) == sorted(hits.values()) and max(hits.values()) <= 0.5
    assert len({design.speed for design in hits}) > 1  # the table does not say at which speed
    (ours,) = [design for design in hits if design.speed == pytest.approx(V)]
    assert ours.placement == "real"
    assert ours.q_ratio == pytest.approx(25.12, abs=0.01)


# Margins: a loop with the factor applied has a pole on the unit circle, there.
DT = 0.01


def nearest_pole(loop: control.StateSpace, omega: float) -> float:
    """How far the closed loop's nearest pole is from exp(j omega dt)."""
    poles = control.feedback(loop, 1).poles()
    return float(np.abs(poles - np.exp(1j * omega * loop.dt)).min())


def random_loop(rng: np.random.Generator) -> control.StateSpace:
    radius, angle = rng.uniform(0.3, 0.98, 2), rng.uniform(0.05, 3.0, 2)
    poles = [*(radius * np.exp(1j * angle)), *(radius * np.exp(-1j * angle)), 0.5, 1.0]
    zeros = rng.uniform(-2.0, 2.0, 4)
    return control.ss(control.tf(rng.uniform(0.01, 1.0) * np.poly(zeros), np.poly(poles).real, DT))


@pytest.mark.parametrize("seed", range(12))
def test_every_gain_margin_puts_a_pole_on_the_unit_circle(seed: int) -> None:
    loop = random_loop(np.random.default_rng(seed))
    found = _find_crossings(loop)
    for factor, omega in found:
        # poles of a sixth-order polynomial: good to about the square root of its rounding
        assert nearest_pole(factor * loop, omega) < 1e-7
    assert (np.diff(found[:, 1]) > 0.0).all()


@pytest.mark.parametrize("seed", range(12))
def test_python_control_finds_the_same_below_half_the_sampling_rate(seed: int) -> None:
    loop = random_loop(np.random.default_rng(seed))
    found = _find_crossings(loop)
    gains, _, _, at_gain, _, _ = control.stability_margins(control.tf(loop), returnall=True)
    inside = found[found[:, 1] < 0.999 * math.pi / DT]
    # near 0 it reports roundings of the pole at z = 1 as crossings
    theirs = (at_gain > 1e-5 * math.pi / DT) & (at_gain < 0.999 * math.pi / DT)
    assert inside[:, 0] == pytest.approx(gains[theirs], rel=1e-6)


def test_the_crossover_at_half_the_sampling_rate() -> None:
    """Jury's test for k / (z - 1/2): stable for -1/2 < k < 3/2, the upper end at z = -1."""
    loop = control.ss(control.tf([1.0], [1.0, -0.5], DT))
    assert _find_crossings(loop) == pytest.approx(np.array([[1.5, math.pi / DT]]), rel=1e-12)
    assert _compute_gain_margin(loop)[0] == pytest.approx(20.0 * math.log10(1.5), rel=1e-12)
    assert np.abs(control.feedback(1.499 * loop, 1).poles()).max() < 1.0
    assert np.abs(control.feedback(1.501 * loop, 1).poles()).max() > 1.0
    lost = control.stability_margins(loop)[0]
    assert math.isinf(lost), "python-control finds it too now: say so in the docstring"


def test_a_positive_end_is_no_crossover() -> None:
    assert (
        _find_crossings(control.ss(control.tf([-1.0], [1.0, -0.5], DT)))[:, 1] < math.pi / DT
    ).all()


def test_a_loop_that_never_crosses_has_infinite_margins() -> None:
    loop = control.ss(control.tf([0.1, 0.02], [1.0, 0.0], DT))  # positive real, gain below 1
    assert _compute_gain_margin(loop)[0] == math.inf and len(_find_crossings(loop)) == 0
