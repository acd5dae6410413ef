"""dakf-stability Fig. 7: the thresholds of an honest implementation, and what they leave out."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

from sideslip.agents.rollout import Rollout
from sideslip.benchmarks.papers.manoeuvres import FollowingSimulation

FIG7: dict[str, Any] = {
    "base": "dakf-fig6",
    "name": "step steer by wire",
    "steering": "step",
    "onset": 1.0,
    "amplitude": 0.06,
    "hold": 100.0,
    "gps_outage": None,
    "half_width": 1e6,  # ten seconds of a turn leave any proving ground
    "lags": True,
    "vehicle": {
        "front_stiffness": 7000.0,
        "rear_stiffness": 7000.0,
        "motor_lag": 0.0,
        "steering_lag": 0.03,
    },
}

pytestmark = pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")


def drive(seed: int, scenario: Any, **options: Any) -> tuple[Rollout, dict[str, float]]:
    return FollowingSimulation("f", scenario, {"a": options})._run_episode("a", seed)


def compared(seeds: Iterable[int], scenario: Any, **options: Any) -> dict[str, Any]:
    """With control over without it, (seeds,) each: RMS errors of beta and gamma, peak of beta.

    `saturated` and `failed` are those with control. options: of the controller.
    """
    rows = []
    for seed in seeds:
        _, none = drive(seed, scenario, agent="none")
        episode, ours = drive(seed, scenario, **options)
        ours["failed"] = episode.failed
        ratios = {x: ours[x] / none[x] for x in ("rms_beta", "rms_gamma", "peak_beta")}
        rows.append(ours | ratios)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def test_the_numbers_are_those_of_the_episode() -> None:
    episode, found = drive(0, FIG7 | {"duration": 2.0})
    assert found["rms_beta"] == np.sqrt(np.mean((episode["beta"] - episode["beta_ref"]) ** 2))
    assert found["rms_gamma"] == np.sqrt(np.mean((episode["gamma"] - episode["gamma_ref"]) ** 2))
    assert found["peak_beta"] == np.max(np.abs(episode["beta"]))
    assert not episode.failed
    assert episode["t"][-1] == 2.0
    assert len(episode["t"]) == 2001
    assert 0.0 < np.abs(episode["action_1"]).max() < 1.0
    _, none = drive(0, FIG7 | {"duration": 2.0}, agent="none")
    assert none["saturated"] == 0.0


@pytest.mark.long
def test_control_tracks_better_than_none() -> None:
    """Worst of ten seeds: beta at most 0.80 of the error without control, gamma 0.50."""
    found = compared(range(10), FIG7)
    assert found["rms_beta"].max() <= 0.80
    assert found["rms_gamma"].max() <= 0.50
    assert not found["failed"].any()


@pytest.mark.long
def test_a_larger_step_saturates_the_motors() -> None:
    small, large = (compared(range(3), FIG7 | {"amplitude": a}) for a in (0.06, 0.1))
    assert (large["saturated"] > 3.0 * small["saturated"]).all()
    assert (large["saturated"] > 0.02).all()
