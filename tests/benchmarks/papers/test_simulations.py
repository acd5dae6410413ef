"""The ledger's simulations: what they take from a drive, and how dakf-stability's car tracks."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents.rollout import rollout
from sideslip.benchmarks.harness.drives import SETTLED, call_quietly, make_filter_arguments
from sideslip.benchmarks.papers import dakf_stability, tie_vision
from sideslip.benchmarks.papers.ledger import join_numbers, run_simulation
from sideslip.benchmarks.papers.manoeuvres import (
    BOUND,
    PAPER_TUNINGS,
    ControlSimulation,
    EstimationSimulation,
    PaperFilter,
    make_filters,
)
from sideslip.estimators import make_estimator

VISION = "sideslip/YawVision-v0"
QUIET = pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")
SHORT: dict[str, Any] = {"base": "tie-vision-fig7", "name": "short", "duration": 2.5}


def test_numbers_of_an_estimation_are_those_of_its_drives() -> None:
    filters = (PaperFilter("a", "multirate-kf"), PaperFilter("b", "bicycle-kf", vehicle="true"))
    simulation = EstimationSimulation("short", VISION, SHORT, filters, bound=True)
    found = join_numbers(simulation.run((3, 5)))
    env = gym.make(VISION, scenario=SHORT, control_period=10)
    base: Any = env.unwrapped
    for i, seed in enumerate((3, 5)):
        drive = rollout(env, seed=seed)
        truth, late = drive.log.truth, drive.log.time >= SETTLED - 1e-9
        for label, name, car in (
            ("a", "multirate-kf", base.nominal),
            ("b", "bicycle-kf", base.vehicle),
        ):
            run = make_estimator(
                name, vehicle=car, sensors=drive.log.slow, speed=base.held_speed
            ).run(drive.log)
            error = (run["gamma"] - truth["gamma"])[late]
            assert found[label, "gamma"][i] == pytest.approx(np.sqrt(np.mean(error**2)))
    assert ("a", "y_l") in found and ("b", "y_l") not in found
    assert (found[BOUND, "beta"] > 0.0).all()


def test_the_first_seed_leaves_its_signals() -> None:
    short = EstimationSimulation("short", VISION, SHORT, (PaperFilter("a", "bicycle-kf"),))
    first, second = run_simulation((short, (0, 1)))
    assert set(first.curves) == {"truth", "a"}
    assert not second.curves and second.numbers.keys() == first.numbers.keys()


def test_a_car_that_fails_is_no_estimation() -> None:
    scenario = SHORT | {"half_width": 0.3}
    with pytest.raises(RuntimeError, match="narrow: the car of seed 0 failed"):
        next(EstimationSimulation("narrow", VISION, scenario, ()).run((0,)))


def test_options_of_a_contestant_reach_its_agent() -> None:
    names, label = ("none", "multirate"), "multirate, stronger"
    drivers = {name: tie_vision._DRIVERS[name] for name in names}
    drivers[label] = drivers["multirate"]._replace(options={"rate": "control", "gain": 5.0})
    slip = ControlSimulation("s", VISION, "tie-vision-fig8", drivers)
    numbers = join_numbers(slip.run((0,)))
    assert numbers["none", "saturation"] == 0.0
    assert numbers[label, "rms_slip"] < 0.9 * numbers["multirate", "rms_slip"]
    assert numbers[label, "total_variation"] > 2.0 * numbers["multirate", "total_variation"]


def follow(**changes: Any) -> ControlSimulation:
    """dakf-stability Fig. 7; ten seconds of a turn leave any proving ground."""
    scenario = {"base": "dakf-fig7", "name": "step steer by wire", "half_width": 1e6}
    drawn = next(x for x in dakf_stability.SIMULATIONS if x.name == "dakf-fig7")
    assert isinstance(drawn, ControlSimulation)
    return replace(drawn, scenario=scenario | changes)


def test_claims_are_judged_with_the_papers_tuning() -> None:
    """What a figure's own tuning has of dakf is in its filter, and is not the package's."""
    env: Any = gym.make("sideslip/YawGps-v0", scenario="dakf-fig6")
    env.reset(seed=0)
    facts = make_filter_arguments(env.unwrapped)
    (ours,) = make_filters([PaperFilter("dakf", "dakf")], env.unwrapped).values()
    package = call_quietly(make_estimator, "dakf", **facts)
    wanted = call_quietly(make_estimator, "dakf", **facts, **PAPER_TUNINGS["dakf"])
    Q = [np.diag(each.filters[0].Q)[:5] for each in (ours, wanted, package)]
    assert np.array_equal(Q[0], Q[1])
    assert (Q[0] != Q[2]).all()


def compared(seeds: Iterable[int], **changes: Any) -> dict[str, Any]:
    """With control over without it, (seeds,) each: RMS errors of beta and gamma, peak of beta.

    `full_command` and `failed` are those with control.
    """
    rows = []
    for seed in seeds:
        _, none = follow(**changes).drive(dakf_stability.WITHOUT, seed)
        episode, ours = follow(**changes).drive(dakf_stability.WITH, seed)
        ours["failed"] = episode.failed
        ratios = {x: ours[x] / none[x] for x in ("rms_slip_error", "rms_yaw_error", "peak_slip")}
        rows.append(ours | ratios)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


@QUIET
def test_following_has_the_reference_beside_the_car() -> None:
    simulation, label = follow(duration=2.0), dakf_stability.WITHOUT
    episode, found = simulation.drive(dakf_stability.WITH, 0)
    for quantity, name in (("rms_slip_error", "beta"), ("rms_yaw_error", "gamma")):
        error = episode[name] - episode[f"{name}_ref"]
        assert found[quantity] == np.sqrt(np.mean(error**2))
    assert found["peak_slip"] == np.max(np.abs(episode["beta"]))
    assert not episode.failed and episode["t"][-1] == 2.0 and len(episode["t"]) == 2001
    assert 0.0 < np.abs(episode["action_1"]).max() < 1.0
    none = next(replace(simulation, drivers={label: simulation.drivers[label]}).run((0,)))
    error = none.curves[label]["gamma"] - none.curves["reference"]["gamma"]
    assert none.numbers[label, "rms_yaw_error"] == pytest.approx(np.sqrt(np.mean(error**2)))
    assert none.numbers[label, "full_command"] == 0.0


@QUIET
@pytest.mark.long
def test_control_tracks_better_than_none() -> None:
    """Worst of ten seeds: beta at most 0.80 of the error without control, gamma 0.50."""
    found = compared(range(10))
    assert found["rms_slip_error"].max() <= 0.80
    assert found["rms_yaw_error"].max() <= 0.50
    assert not found["failed"].any()


@QUIET
@pytest.mark.long
def test_a_larger_step_saturates_the_motors() -> None:
    small, large = (compared(range(3), amplitude=a) for a in (0.06, 0.1))
    assert (large["full_command"] > 3.0 * small["full_command"]).all()
    assert (large["full_command"] > 0.02).all()
