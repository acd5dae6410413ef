"""What is no estimator of a user's own is refused, by name, as early as can be known."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents.rollout import rollout
from sideslip.envs import COMS
from sideslip.estimators import EstimateObservation, make_estimator, smooth, vector
from sideslip.estimators.make import ESTIMATORS, register_estimator
from tests.estimators.wrappers.constant import Constant

VISION = "sideslip/YawVision-v0"
FIG7: dict[str, Any] = {"scenario": "tie-vision-fig7"}
STILL = np.zeros(1, np.float32)


@pytest.fixture(autouse=True)
def own_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers is gone after it."""
    monkeypatch.setattr(ESTIMATORS, "_factories", dict(ESTIMATORS._factories))


def without(member: str) -> Any:
    """A class like `Constant` that lacks a member."""
    body = {key: value for key, value in vars(Constant).items() if key != member}
    return type("Lacking", (), {key: body[key] for key in body if not key.startswith("__d")})


@pytest.mark.parametrize(
    ("source", "error", "message"),
    [
        (3, TypeError, "int is no estimator: int has no names, reset, step"),
        (without("reset"), TypeError, "Lacking is no estimator: Lacking has no reset;"),
        (without("step")(), TypeError, "Lacking is no estimator: Lacking has no step;"),
        (without("names"), TypeError, "Lacking has no names;"),
        (lambda **_: None, TypeError, "NoneType has no names, reset, step"),
        (lambda vehicle: None, TypeError, "unexpected keyword argument"),
        ("no.such:Thing", ValueError, "there is no module 'no'"),
        (f"{__name__}:Thing", ValueError, "has no 'Thing'"),
        (f"{__name__}:STILL", TypeError, "is no factory but of type ndarray"),
        ("exact-fk", ValueError, "unknown estimator 'exact-fk'; did you mean 'exact-kf'"),
    ],
)
def test_what_is_no_estimator_is_refused_at_once(source: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        EstimateObservation(gym.make(VISION), source)


@pytest.mark.parametrize("names", [(), "beta", ("beta", "beta"), ("beta", 3), ("beta", "")])
def test_names_are_distinct_words(names: Any) -> None:
    own = Constant()
    own.names = names
    with pytest.raises(ValueError, match="Constant: names are distinct words, one a state, got"):
        EstimateObservation(gym.make(VISION), own)


@pytest.mark.parametrize(
    ("value", "error", "message"),
    [
        (np.zeros((3, 1)), ValueError, r"x has shape \(3,\) for the states mu, gamma, beta, got"),
        (0.1, ValueError, r"x has shape .* got \(\)"),
        ("fast", TypeError, "x is no array of numbers"),
        (None, ValueError, r"got \(\)"),
    ],
)
def test_a_wrong_estimate_is_named_at_the_reset(value: Any, error: Any, message: str) -> None:
    env: Any = EstimateObservation(gym.make(VISION), Constant(value))
    with pytest.raises(error, match=message):
        env.reset(seed=0)


def test_other_bad_arguments() -> None:
    with pytest.raises(ValueError, match="Constant has no state 'psi'; it has: mu, gamma, beta"):
        EstimateObservation(gym.make(VISION), Constant, outputs=["psi"])
    lacking: Any = EstimateObservation(gym.make(VISION), without("P"))
    with pytest.raises(TypeError, match=r"P is no array of numbers.*no attribute 'P'"):
        lacking.reset(seed=0)
    for more in ({"vehicle": COMS}, {"options": {"gain": 1}}):
        with pytest.raises(ValueError, match="Constant is built already: a vehicle and options"):
            EstimateObservation(gym.make(VISION), Constant(), **more)
    base: Any = gym.make(VISION).unwrapped
    slower = make_estimator("bicycle-kf", sensors=base.slow_sensors, dt=2e-3)
    with pytest.raises(ValueError, match=r"bicycle-kf was built for ticks of 0.002 s, the env has"):
        EstimateObservation(gym.make(VISION), slower)
    with pytest.raises(ValueError, match="tick of 0"):
        make_estimator(Constant, dt=0.0)
    register_estimator("constant", Constant)
    with pytest.raises(TypeError, match="catalogue without latency, got <constant: mu"):
        smooth("constant", rollout(gym.make(VISION), options={"duration": 0.05}).log, gain=2)


def test_a_record_without_rows_or_of_other_ticks() -> None:
    log = rollout(gym.make(VISION, **FIG7), seed=3, options={"duration": 0.05}).log
    found = make_estimator(Constant, sensors=log.slow)
    assert found.run(log)["mu"].tolist() == [0.8] * len(log.record.fast)
    log.record.dt = 2e-3
    with pytest.raises(ValueError, match=r"ticks of 0.001 s, the record has 51 of 0.002 s"):
        found.run(log)
    log.record.fast, log.record.dt = log.record.fast[:0], 1e-3
    with pytest.raises(ValueError, match="the record has 0 of"):
        found.run(log)


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ({"outputz": ["beta"]}, "unknown argument of EstimateObservation 'outputz'; .*'outputs'"),
        ({"gyro_noize": 0.1}, "exact-kf: unknown option 'gyro_noize'; did you mean 'gyro_noise'"),
        ({"gyro_noise": 0.1}, r"passed as options=\{'gyro_noise': 0.1\}"),
    ],
)
def test_a_misplaced_argument_is_refused_with_the_nearest_name(
    argument: dict[str, Any], message: str
) -> None:
    with pytest.raises(TypeError, match=message):
        EstimateObservation(gym.make(VISION), "exact-kf", **argument)
    with pytest.raises(TypeError, match=message):
        vector.EstimateObservation(gym.make_vec(VISION, 2), "exact-kf", **argument)
