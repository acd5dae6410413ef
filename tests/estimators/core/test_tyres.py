"""Tyres as states: the law and its slopes, a known tyre, unknown ones, ones that change."""

import functools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import sideslip
from sideslip.agents.rollout import rollout
from sideslip.envs import Log
from sideslip.envs.record import PACKET
from sideslip.envs.vehicle.tyres import FIALA, Tyre, compute_lateral_forces
from sideslip.estimators import Estimator, make_estimator
from sideslip.estimators.analysis.bound import compute_error_bound
from sideslip.estimators.core.model import compute_axle_force
from sideslip.estimators.core.multiple_model import replace_least_likely
from sideslip.estimators.design.assemble import HAZARD, REPLACE_TIME

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
CHANGED = {"tyre_change_time": 4.0, "front_change": 0.6, "rear_change": 1.3}
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


def built(base: Any, log: Log, name: str = "joint", **options: Any) -> Estimator:
    return make_estimator(
        name, vehicle=base.nominal, sensors=log.slow, speed=base.held_speed, slow=["camera", "gps"],
        **options,
    )  # fmt: skip


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
        force, *slopes = compute_axle_force(C, F_z, *at)
        tyre = Tyre(alpha, friction * F_z / 2, C * factor / 2 / (3.0 * friction * F_z / 2))
        pair = compute_lateral_forces(tyre, tyre, tyre, tyre, FIALA, 0)
        assert force == pytest.approx(pair[0] + pair[1], rel=1e-12)
        whole = abs(alpha) * C * factor / (3.0 * F_z * friction)
        for i, slope in enumerate(slopes):
            step = 1e-6 * (np.arange(3) == i)
            ahead, back = (
                compute_axle_force(C, F_z, *(np.array(at) + s))[0] for s in (step, -step)
            )
            if whole < 0.85 or i == 2:  # where it slides the slope by slip is kept above zero
                assert slope == pytest.approx((ahead - back) / 2e-6, rel=1e-5, abs=1e-3)
    assert compute_axle_force(C, F_z, 0.1, factor, 0.0)[0] == pytest.approx(C * factor * 0.1)


def test_with_known_tyres_it_is_the_linear_filter() -> None:
    """A prior of almost nothing leaves the nominal bicycle, late camera and GPS included."""
    base, ((log, _), *_) = drives(1)
    sure: dict[str, Any] = {"front_tyres_sd": 1e-9, "rear_tyres_sd": 1e-9}
    joint, exact = built(base, log, **sure).run(log), built(base, log, "exact-kf").run(log)
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
        nominal.append(squares(built(base, log, "exact-kf"), log)[0])
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


def test_a_bank_believes_a_change_sooner() -> None:
    """Whenever it comes between two members that begin anew."""
    for changed in (4.0, 4.3):
        base, made = drives(4, **CHANGED | {"tyre_change_time": changed})
        late = round(1000 * changed) + 500
        single, bank = (
            [squares(built(base, log, members=count), log, late)[0] for log, _ in made]
            for count in (1, 4)
        )
        assert np.sqrt(np.mean(bank) / np.mean(single)) < 0.7


def test_what_a_member_remembers_of_its_tyres_is_forgotten_too() -> None:
    """Or a late sample, for which the past is filtered anew, brings them back."""
    base, ((log, _), *_) = drives(1)
    filter_ = built(base, log, members=2, delay="buffer")
    record = filter_.prepare_record(log)
    filter_.reset(log.slow, record.first)
    due = record.packets[:, PACKET.arrived] <= record.first + 4500
    filter_.step(record.fast[:4501], record.packets[due])
    (new,) = (f for f in filter_.filters[1:] if f.fresh > 0.0)
    assert (new.snapshot_P[:-1, new.tyres, new.tyres] > new.spread).all()


def test_a_member_begins_anew_at_the_odds_of_a_change_since_the_last_one() -> None:
    base, ((log, _), *_) = drives(1)
    filter_ = built(base, log, members=3)
    filter_.run(log)
    weight = filter_.filters.weight
    weight[1:] = [-1.0, 2.0, -9.0]
    replace_least_likely(filter_.filters)
    assert weight[1:3].tolist() == [-3.0, 0.0]
    assert np.exp(weight[3]) == pytest.approx(HAZARD * REPLACE_TIME)


def test_no_member_of_a_bank_is_another_s_twin() -> None:
    base, ((log, _), *_) = drives(1)
    filter_ = built(base, log, members=4)
    filter_.run(log)
    factors = [f.P[f.tyres, f.tyres] for f in filter_.filters[1:]]
    assert len(set(factors)) == len(factors)


def test_a_bank_costs_nothing_without_a_change() -> None:
    base, made = drives(4)
    single, bank = (
        [squares(built(base, log, members=count), log)[0] for log, _ in made] for count in (1, 4)
    )
    assert np.sqrt(np.mean(bank) / np.mean(single)) < 1.05


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_a_bank_finds_the_level_of_the_disturbances(factor: float) -> None:
    """Beside the filter that knows it; alone and at another level its deviation is wrong."""
    force, moment = 50.0 * factor, 20.0 * factor
    base, made = drives(4, disturbance_force=force, disturbance_moment=moment)
    found = np.array([
        [squares(built(base, log, **options), log)
         for options in ({}, {"levels": (0.5, 1.0, 2.0)}, {"force_sd": force, "moment_sd": moment})]
        for log, _ in made
    ]).mean(axis=0)  # fmt: skip
    assert np.sqrt(found[1, 0] / found[2, 0]) < 1.05
    assert 0.7 < found[1, 1] < 1.5
    assert factor == 1.0 or not 0.5 < found[0, 1] < 2.0


def test_a_member_that_begins_anew_stays_at_its_level() -> None:
    base, ((log, _), *_) = drives(1, **CHANGED)
    filter_ = built(base, log, levels=[[0.5, 2.0], [1.0, 1.0]], members=3, bias_sd=0.01)
    alone = built(base, log, bias_sd=0.01).filters[0]
    filter_.run(log)
    for f, (force, moment) in zip(
        filter_.filters[1:], ((0.5, 2.0), (1.0, 1.0), (0.5, 2.0)), strict=True
    ):
        d = f.dense
        np.testing.assert_allclose(np.diag(f.Q)[d : d + 2], f.q_known, rtol=1e-12)
        ratio = np.diag(f.Q)[d : d + 2] / np.diag(alone.Q)[d : d + 2]
        np.testing.assert_allclose(ratio, [force**2, moment**2], rtol=1e-12)


@pytest.mark.parametrize("options", [{"members": 4}, {"members": 4, "levels": (0.5, 2.0)}])
def test_a_bank_that_begins_again_is_the_one_that_was_made(options: dict[str, Any]) -> None:
    base, made = drives(1, **CHANGED)
    filter_ = built(base, made[0][0], **options)
    first, again = (filter_.run(made[0][0]) for _ in range(2))
    assert np.array_equal(first.x, again.x) and np.array_equal(first.std, again.std)


@pytest.mark.parametrize("options", [{"members": 3}])
def test_a_bank_step_by_step_and_from_a_snapshot_is_the_same(options: dict[str, Any]) -> None:
    base, ((log, _), *_) = drives(1, **CHANGED)
    whole, parts = built(base, log, **options), built(base, log, **options)
    expected = whole.run(log).x
    record = parts.prepare_record(log)
    ends = np.searchsorted(record.packets[:, PACKET.arrived], record.ticks, "right")
    start = 0
    for k in range(0, 5000, 7):
        rows = slice(k, k + 7)
        end = int(ends[min(k + 6, len(ends) - 1)])
        if k == 3500:
            other = built(base, log, **options)
            other.reset(log.slow, record.first)
            other.set_state(parts.get_state())
            parts = other
        parts.step(record.fast[rows], record.packets[start:end])
        start = end
    np.testing.assert_array_equal(parts.x, expected[k + 6])
