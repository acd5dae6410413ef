"""What is no estimator, or no argument for one, is refused by name, as early as can be known."""

import functools
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

from sideslip.agents.rollout import rollout
from sideslip.envs import COMS
from sideslip.estimators import EstimateObservation, make_estimator, smooth, vector
from sideslip.estimators.make import register_estimator
from sideslip.estimators.vector.estimate import TruthObservation as VectorTruthObservation
from sideslip.estimators.wrappers.truth import TruthObservation
from tests.estimators.wrappers.constant import Constant

pytestmark = pytest.mark.usefixtures("own_names")

VISION, FUSION = "sideslip/YawVision-v0", "sideslip/YawFusion-v0"
STILL = np.zeros(1, np.float32)


def without(member: str) -> Any:
    """A class like `Constant` that lacks a member."""
    body = {key: value for key, value in vars(Constant).items() if key != member}
    return type("Lacking", (), {key: body[key] for key in body if not key.startswith("__d")})


def named(names: Any) -> Any:
    return type("Constant", (Constant,), {"names": names})


def wrap(source: Any, make: Any = lambda: gym.make(VISION), **options: Any) -> Callable[[], Any]:
    return lambda: EstimateObservation(make(), source, **options)


def estimate(*value: Any, make: Any = Constant) -> Callable[[], Any]:
    return lambda: wrap(make(*value))().reset(seed=0)


def truth(*arguments: Any, make: Any = lambda: gym.make(FUSION)) -> Callable[[], Any]:
    return lambda: TruthObservation(make(), *arguments)


def truths(make: Callable[[], Any], *arguments: Any) -> Callable[[], Any]:
    return lambda: VectorTruthObservation(make(), *arguments)


def wrapped(wrapper: Any, env_id: str) -> Callable[[], Any]:
    return lambda: wrapper(gym.make(env_id))


def make_slower() -> Any:
    sensors = gym.make(VISION).get_wrapper_attr("slow_sensors")
    return wrap(make_estimator("bicycle-kf", sensors=sensors, dt=2e-3))()


def smooth_constant() -> Any:
    register_estimator("constant", Constant)
    return smooth("constant", rollout(gym.make(VISION), options={"duration": 0.05}).log, gain=2)


FUSED = functools.partial(gym.make, FUSION)
CLIPPED = wrapped(gym.wrappers.ClipAction, VISION)
CART = wrapped(lambda env: env.unwrapped, "CartPole-v1")
PLAIN = wrap("bicycle-kf", name="plain")
SAME_STEP = functools.partial(gym.make_vec, FUSION, num_envs=2, autoreset_mode="SameStep")
STATES = "states mu, gamma, beta, got"
DISTINCT = "Constant: names are distinct words, one a state, got"
TWICE = r"plain_beta_hat.* would stand twice; give"
NO_PSI = "Constant has no state 'psi'; it has: mu, gamma, beta"
BUILT = "Constant is built already: a vehicle and options"
REFUSED: list[tuple[Callable[[], Any], type[Exception], str]] = [
    # no estimator
    (wrap(3), TypeError, "int is no estimator: int has no names, reset, step"),
    (wrap(without("reset")), TypeError, "Lacking is no estimator: Lacking has no reset;"),
    (wrap(without("step")()), TypeError, "Lacking is no estimator: Lacking has no step;"),
    (wrap(without("names")), TypeError, "Lacking has no names;"),
    (wrap(lambda **_: None), TypeError, "NoneType has no names, reset, step"),
    (wrap(lambda vehicle: None), TypeError, "unexpected keyword argument"),
    (wrap("no.such:Thing"), ValueError, "there is no module 'no'"),
    (wrap(f"{__name__}:Thing"), ValueError, "has no 'Thing'"),
    (wrap(f"{__name__}:STILL"), TypeError, "is no factory but of type ndarray"),
    (wrap("exact-fk"), ValueError, "unknown estimator 'exact-fk'; did you mean 'exact-kf'"),
    *(
        (wrap(named(names)), ValueError, DISTINCT)
        for names in ((), "beta", ("beta", "beta"), ("beta", 3), ("beta", ""))
    ),
    # a wrong estimate
    (estimate(np.zeros((3, 1))), ValueError, rf"x has shape \(3,\) for the {STATES}"),
    (estimate(0.1), ValueError, r"x has shape .* got \(\)"),
    (estimate("fast"), TypeError, "x is no array of numbers"),
    (estimate(None), ValueError, r"got \(\)"),
    (estimate(make=without("P")), TypeError, r"P is no array of numbers.*no attribute 'P'"),
    # arguments that do not fit
    (wrap(Constant, outputs=["psi"]), ValueError, NO_PSI),
    (wrap("bicycle-kf", outputs=["psi"]), ValueError, "no state 'psi'"),
    (wrap(Constant(), vehicle=COMS), ValueError, BUILT),
    (wrap(Constant(), options={"gain": 1}), ValueError, BUILT),
    (wrap("dakf"), ValueError, "dakf needs the slow sensor gps; there is: camera"),
    (wrap("multirate-kf", options={"q": 1}), TypeError, "unknown option 'q'"),
    (make_slower, ValueError, r"bicycle-kf was built for ticks of 0.002 s, the env has"),
    (lambda: make_estimator(Constant, dt=0.0), ValueError, "tick of 0"),
    (smooth_constant, TypeError, "catalogue without latency, got <constant: mu"),
    # places where the wrapper cannot stand
    (wrap("multirate-kf", CLIPPED), TypeError, r"innermost wrapper.*ClipAction"),
    (wrap("multirate-kf", CART), TypeError, "CartPoleEnv has no rows"),
    (wrap("exact-kf", PLAIN, name="plain"), ValueError, TWICE),
    # the true car
    (truth(["colour"]), ValueError, "unknown parameter of a vehicle 'colour'; "),
    (truth([], ["mood"]), ValueError, "unknown true state 'mood'; known: beta"),
    (truth(["mass"], make=truth(["mass"])), ValueError, "two are stacked"),
    (truth([], ["beta"], make=wrap("exact-kf")), ValueError, "beta_hat would stand twice"),
    (truths(lambda: SyncVectorEnv([FUSED])), TypeError, "has no layout"),
    (truths(SAME_STEP, [], ["beta"]), ValueError, "true states need autoreset_mode"),
]


@pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")
@pytest.mark.parametrize(("call", "error", "message"), REFUSED, ids=[row[2] for row in REFUSED])
def test_what_cannot_be_is_refused(call: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        call()


def test_a_record_without_rows_or_of_other_ticks() -> None:
    env = gym.make(VISION, scenario="tie-vision-fig7")
    log = rollout(env, seed=3, options={"duration": 0.05}).log
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
def test_a_misplaced_argument_is_named_and_refused(argument: dict[str, Any], message: str) -> None:
    with pytest.raises(TypeError, match=message):
        EstimateObservation(gym.make(VISION), "exact-kf", **argument)
    with pytest.raises(TypeError, match=message):
        vector.EstimateObservation(gym.make_vec(VISION, 2), "exact-kf", **argument)
