"""Tyres as states: the law and its slopes, a known tyre, unknown ones, ones that change."""

import functools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import sideslip
from sideslip.agents.rollout import rollout
from sideslip.envs import Log
from sideslip.envs.vehicle.tyres import FIALA, Tyre, compute_lateral_forces
from sideslip.estimators import Estimator, make_estimator
from sideslip.estimators.analysis.limits import compute_error_bound
from sideslip.estimators.core.model import _compute_axle_force
from tests.estimators.dense import WITH_TYRES

assert sideslip.__version__
LINEAR: dict[str, Any] = {
    "base": "random-steering",
    "speed": 25.0 / 3.6,
    "small_angle": True,
    "tyres": "linear",
    "roll": False,
    "lags": False,
    "amplitude": (0.03, 0.08),
    "amplitude_2": (0.02, 0.05),
    "front_stiffness": (0.6, 1.4),
    "rear_stiffness": (0.6, 1.4),
}
SETTLED = 2000  # ticks


@functools.cache
def drives(count: int, **more: float) -> tuple[Any, list[tuple[Log, Any]]]:
    """The env, and (log, true vehicle) of some seeds; more: of the scenario."""
    env: Any = gym.make("sideslip/YawFusion-v0", scenario=LINEAR | more)
    made = []
    for seed in range(count):
        log = rollout(env, seed=seed).log
        made.append((log, env.unwrapped.vehicle))
    return env.unwrapped, made


def built(base: Any, log: Log, tyres: dict[str, Any] = WITH_TYRES, **options: Any) -> Estimator:
    held = {"vehicle": base.nominal, "sensors": log.slow, "speed": base.held_speed}
    return make_estimator("exact-kf", **held, slow=["camera", "gps"], **tyres | options)


def squares(filter_: Estimator, log: Log, since: int = SETTLED) -> tuple[float, float]:
    """(mean squared error of beta, mean NEES of beta) from a tick on."""
    found = filter_.run(log)
    error = (found.x[:, 0] - log.truth["beta"])[since:]
    return float(np.mean(error**2)), float(np.mean((error / found.std[since:, 0]) ** 2))


@pytest.mark.parametrize("factor", [0.6, 1.0])
@pytest.mark.parametrize("friction", [0.4, 0.9])
def test_the_law_is_the_plants_and_its_slopes_are_differences(
    factor: float, friction: float
) -> None:
    C, F_z = 24000.0, 4000.0
    for alpha in (-0.3, -0.02, -0.001, 0.004, 0.05, 0.2):
        at = (alpha, factor, 1.0 / friction)
        force, *slopes = _compute_axle_force(C, F_z, *at)
        tyre = Tyre(alpha, friction * F_z / 2, C * factor / 2 / (3.0 * friction * F_z / 2))
        pair = compute_lateral_forces(tyre, tyre, tyre, tyre, FIALA, 0)
        assert force == pytest.approx(pair[0] + pair[1], rel=1e-12)
        whole = abs(alpha) * C * factor / (3.0 * F_z * friction)
        for i, slope in enumerate(slopes):
            step = 1e-6 * (np.arange(3) == i)
            ahead, back = (
                _compute_axle_force(C, F_z, *(np.array(at) + s))[0] for s in (step, -step)
            )
            if whole < 0.85 or i == 2:  # where it slides the slope by slip is kept above zero
                assert slope == pytest.approx((ahead - back) / 2e-6, rel=1e-5, abs=1e-3)
    assert _compute_axle_force(C, F_z, 0.1, factor, 0.0)[0] == pytest.approx(C * factor * 0.1)


def test_with_known_tyres_it_is_the_linear_filter() -> None:
    """A prior of almost nothing leaves the nominal bicycle, late camera and GPS included."""
    base, ((log, _), *_) = drives(1)
    sure: dict[str, Any] = {"front_tyres_sd": 1e-9, "rear_tyres_sd": 1e-9}
    joint, exact = built(base, log, **sure).run(log), built(base, log, {}).run(log)
    n = exact.x.shape[1]
    scale = np.abs(exact.x).max(axis=0)
    assert (np.abs(joint.x[:, :n] - exact.x) < 1e-6 * scale).all()
    np.testing.assert_allclose(joint.std[1:, :n], exact.std[1:], rtol=1e-6)


def test_unknown_tyres_cost_a_tenth_and_not_a_factor_of_five() -> None:
    """Root mean square over eight cars, over the bound that knows the tyres."""
    base, made = drives(8)
    ours, nominal, best, nees = [], [], [], []
    for log, truth in made:
        error, consistent = squares(built(base, log, bias_sd=0.005), log)
        ours.append(error)
        nees.append(consistent)
        nominal.append(squares(built(base, log, {}), log)[0])
        least = compute_error_bound(
            truth, record=log.record, sensors=log.slow, speed=base.held_speed
        )
        best.append(np.mean(least[SETTLED:] ** 2))
    assert np.sqrt(np.mean(ours) / np.mean(best)) < 1.25
    assert np.sqrt(np.mean(nominal) / np.mean(best)) > 3.0
    assert 0.5 < np.mean(nees) < 1.7


def test_the_factors_are_found() -> None:
    base, made = drives(4)
    for log, truth in made:
        filter_ = built(base, log)
        found = filter_.run(log)
        for axle in ("front", "rear"):
            at = filter_.names.index(f"{axle}_tyres")
            true = getattr(truth, f"{axle}_stiffness") / getattr(base.nominal, f"{axle}_stiffness")
            assert abs(found.x[-1, at] - true) < 4.0 * found.std[-1, at] < 0.4
