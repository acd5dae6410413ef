"""EstimateObservation around the real environments."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sideslip.agents.rollout import rollout
from sideslip.estimators import EstimateObservation, make_estimator
from sideslip.estimators.vector import estimate as vector

pytestmark = pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")

VISION, UNEVEN, GPS = (f"sideslip/Yaw{kind}-v0" for kind in ("Vision", "VisionUneven", "Gps"))
FIG7: dict[str, Any] = {"scenario": "tie-vision-fig7"}


def still(env: Any) -> Any:
    return np.zeros(env.action_space.shape, np.float32)


@pytest.mark.parametrize(
    ("env_id", "name"),
    [
        pytest.param(VISION, "bicycle-kf", marks=pytest.mark.plain),
        (VISION, "single-rate-kf"),
        (VISION, "multirate-kf"),
        (VISION, "multirate-residual-kf"),
        (VISION, "exact-kf"),
        (UNEVEN, "multirate-residual-kf"),
        (UNEVEN, "exact-kf"),
        (GPS, "course-kf"),
        (GPS, "dakf"),
        (GPS, "exact-kf"),
        (VISION, "tests.estimators.wrappers.ukf:Ukf"),
    ],
)
@pytest.mark.parametrize("control_period", [1, 10, 33])
def test_the_wrapped_filter_equals_it_on_a_log(env_id: Any, name: Any, control_period: Any) -> None:
    """Equal bits for every control period, and what is observed is what the filter says."""
    seconds, options = {"duration": 0.7}, dict[str, Any]()
    if ":" in name:  # a user's own
        pytest.importorskip("tests.estimators.wrappers.ukf", exc_type=ImportError)
        seconds, options = {"duration": 0.2}, {"gyro": 0.01}
    env: Any = gym.make(env_id, control_period=control_period, **FIG7)
    wrapped = EstimateObservation(env, name, options=options)
    obs, info = wrapped.reset(seed=3, options=seconds)
    start = info["beta_hat"]
    while True:
        obs, _, terminated, truncated, info = wrapped.step(still(env))
        assert wrapped.observation_space.contains(obs)
        if terminated or truncated:
            break
    log = rollout(gym.make(env_id, **FIG7), seed=3, options=seconds).log
    facts = {"vehicle": env.unwrapped.nominal, "speed": env.unwrapped.held_speed}
    found = make_estimator(name, sensors=log.slow, **facts, **options).run(log)
    np.testing.assert_array_equal(wrapped.estimator.x, found.x[-1])
    assert [info["beta_hat"], info["beta_std"]] == [found["beta"][-1], found.std[-1, 0]]
    assert start != info["beta_hat"]
    np.testing.assert_array_equal(obs[-4:-2], found.x[-1, :2].astype(np.float32))
    np.testing.assert_array_equal(obs[-2:], found.std[-1, :2].astype(np.float32))
    P, e = wrapped.estimator.P[:2, :2], found.x[-1, :2] - [info["beta"], info["gamma"]]
    assert info["nees"] == pytest.approx(e @ np.linalg.solve(P, e) / 2.0)


@pytest.mark.smoke
def test_layout_and_space_describe_the_observation() -> None:
    inner = gym.make(VISION)
    env: Any = EstimateObservation(inner, "multirate-kf", outputs=["beta", "y_l"])
    names = [entry.name for entry in env.layout]
    assert names[: len(names) - 4] == [entry.name for entry in inner.get_wrapper_attr("layout")]
    assert names[-4:] == ["beta_hat", "y_l_hat", "beta_std", "y_l_std"]
    assert env.layout[-3].unit == "m"
    assert env.observation_space.shape == (len(names),)
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs) and obs.dtype == np.float32
    alone = EstimateObservation(gym.make(VISION), "multirate-kf", std=False, replace=True)
    assert [entry.name for entry in alone.layout] == ["beta_hat", "gamma_hat"]
    assert alone.reset(seed=0)[0].shape == (2,)
    with pytest.warns(UserWarning, match="different from the unwrapped version"):
        check_env(alone, skip_render_check=True)


def test_nees_is_the_normalised_error_of_the_outputs_alone() -> None:
    for output, i in (("beta", 0), ("gamma", 1)):
        env: Any = EstimateObservation(gym.make(VISION, **FIG7), "multirate-kf", outputs=[output])
        env.reset(seed=1)
        *_, info = env.step(still(env))
        e = env.estimator.x[i] - info[output]
        assert info["nees"] == pytest.approx(e * e / env.estimator.P[i, i], rel=1e-9)
    fusion = gym.make("sideslip/YawFusion-v1", scenario={"base": "coms-slalom", "gyro_bias": 0.4})
    lost: Any = EstimateObservation(fusion, "joint")
    lost.reset(seed=0)
    healthy = True
    while healthy:
        *_, info = lost.step(still(lost))
        healthy = info["healthy"]
    both = [lost.estimator.names.index(name) for name in ("beta", "gamma")]
    e, P = lost.estimator.x[both] - [info["beta"], info["gamma"]], lost.estimator.P[both][:, both]
    assert info["nees"] == pytest.approx(e @ np.linalg.solve(P, e) / 2.0, rel=1e-9)
    blind = EstimateObservation(gym.make(VISION), "multirate-kf", outputs=["psi"])
    assert "nees" not in blind.reset(seed=0)[1]


@pytest.mark.parametrize(
    ("name", "usual"), [(VISION, "exact-kf"), ("sideslip/YawFusion-v0", "dakf")]
)
def test_the_usual_estimator_fits_the_sensors(name: str, usual: str) -> None:
    """Wherever a wrapper is named without arguments, as rl-zoo's `env_wrapper` does."""
    env: Any = EstimateObservation(gym.make(name))
    assert env.layout == EstimateObservation(gym.make(name), usual).layout
    assert env.spec.additional_wrappers[-1].kwargs["estimator"] == usual
    rows = vector.EstimateObservation(gym.make_vec(name, num_envs=2))
    assert rows.layout == env.layout


def test_several_estimators_stand_side_by_side() -> None:
    env: Any = EstimateObservation(gym.make(VISION, **FIG7), "bicycle-kf", name="plain")

    env = EstimateObservation(env, "exact-kf", std=False)
    env.reset(seed=0)
    for _ in range(30):
        obs, *_, info = env.step(still(env))
    assert info["plain_beta_hat"] != info["beta_hat"]
    values = dict(zip([entry.name for entry in env.layout], obs, strict=True))
    for before, title in (("plain_", "bicycle-kf (plain)"), ("", "exact-kf")):
        hat, std = info[f"{before}beta_hat"], info[f"{before}beta_std"]
        assert values[f"{before}beta_hat"] == np.float32(hat)
        assert env.unwrapped.annotations[title] == (hat, std)


def test_a_reset_tells_the_filter_the_drawn_clock() -> None:
    env: Any = gym.make(VISION, camera={"phase": None})
    wrapped: Any = EstimateObservation(env, "exact-kf")
    phases = set()
    for seed in range(8):
        wrapped.reset(seed=seed)
        for _ in range(12):
            wrapped.step(still(env))
        phase = round(env.unwrapped.slow_sensors["camera"].phase * 1e3)
        assert wrapped.estimator.filters[0].phase[0] == phase
        assert wrapped.estimator.counts == dict.fromkeys(wrapped.estimator.counts, 0)
        phases.add(phase)
    assert len(phases) > 1


def test_a_reset_to_another_scenario_tells_the_filter() -> None:
    env: Any = EstimateObservation(gym.make(VISION, **FIG7), "exact-kf")
    env.reset(seed=0)
    assert env.estimator.filters[0].measured == 0
    env.reset(seed=0, options={"scenario": "uneven-delay-fig5"})
    assert env.estimator.sensors["camera"].delays == (0.020, 0.015, 0.010, 0.025)
    env.reset(seed=0, options={"scenario": "sine"})
    assert env.estimator.filters[0].measured == 1


def test_a_snapshot_has_the_step_limit_inside() -> None:
    env = EstimateObservation(gym.make("sideslip/YawVision-v1", max_episode_steps=12))
    env.reset(seed=0)
    still = np.zeros(1, np.float32)
    for _ in range(4):
        env.step(still)
    snapshot = env.get_state()
    for _ in range(5):
        env.step(still)
    env.set_state(snapshot)
    assert [env.step(still)[3] for _ in range(8)] == [False] * 7 + [True]


def test_a_filter_with_an_accelerometer_knows_whether_the_body_rolls() -> None:
    options: Any = {"scenario": "dakf-fig6", "control_period": 10}
    alone = EstimateObservation(gym.make("sideslip/YawGps-v0", **options), "joint")
    fleet = gym.make_vec("sideslip/YawGps-v0", 2, **options)
    together = vector.EstimateObservation(fleet, "joint")
    alone.reset(seed=0)
    together.reset(seed=[0, 0])
    errors = []
    for _ in range(500):  # a rolling body's gravity would be 0.1 rad of slip in the estimate
        info = alone.step(still(alone))[-1]
        infos = together.step(still(together))[-1]
        assert infos["beta_hat"][0] == info["beta_hat"]
        errors.append(info["beta_hat"] - info["beta"])
    assert np.sqrt(np.mean(np.square(errors[200:]))) < 0.015


@pytest.mark.parametrize("vehicle", [None, "truth", "nominal"])
def test_no_car_that_a_filter_is_told_rolls_where_none_does(vehicle: str | None) -> None:
    env: Any = gym.make("sideslip/YawGps-v0", scenario="dakf-fig6")
    told = env.unwrapped.nominal if vehicle == "nominal" else vehicle
    alone: Any = EstimateObservation(env, "joint", vehicle=told)
    fleet = gym.make_vec("sideslip/YawGps-v0", 2, scenario="dakf-fig6")
    together: Any = vector.EstimateObservation(fleet, "joint", vehicle=told)
    alone.reset(seed=0)
    together.reset(seed=0)
    filters = alone.estimator.filters[0], together.estimator[0].filters[0]
    arms, base = {float(f.roll_arm) for f in filters}, env.unwrapped
    rolling: Any = make_estimator("joint", vehicle=base.nominal, sensors=base.slow_sensors)
    assert len(arms) == 1 and arms.pop() < 0.01 * rolling.filters[0].roll_arm
