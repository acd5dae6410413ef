"""An estimator of a user's own around one environment: FilterPy's UKF and a constant."""

import copy
import functools
import json
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

from sideslip.agents import make_agent
from sideslip.agents.rollout import rollout
from sideslip.benchmarks.harness.drives import LoggedEpisode, make_filter_arguments
from sideslip.envs import COMS
from sideslip.estimators import EstimateObservation, EstimatorFactory, EstimatorLike, make_estimator
from sideslip.estimators.make import register_estimator
from sideslip.estimators.protocol import ForeignEstimator
from tests.envs.helpers import bits
from tests.estimators.wrappers.constant import Constant

if TYPE_CHECKING:
    from tests.estimators.wrappers.ukf import Ukf

pytestmark = pytest.mark.usefixtures("own_names")

VISION = "sideslip/YawVision-v0"
FIG7: dict[str, Any] = {"scenario": "tie-vision-fig7"}
UKF = "tests.estimators.wrappers.ukf:Ukf"
CONSTANT = "tests.estimators.wrappers.constant:Constant"
STILL = np.zeros(1, np.float32)


def ukf() -> EstimatorFactory:
    kind: type[Ukf] = pytest.importorskip("tests.estimators.wrappers.ukf", exc_type=ImportError).Ukf
    return kind


def drive(env: Any, steps: int, seed: int = 3) -> list[Any]:
    """What the reset and each step returned."""
    env.action_space.seed(0)
    return [env.reset(seed=seed), *(env.step(env.action_space.sample()) for _ in range(steps))]


def same_bits(one: list[Any], other: list[Any]) -> None:
    assert [bits(list(each)) for each in one] == [bits(list(each)) for each in other]


def test_a_ukf_estimates_the_sideslip_and_knows_how_well() -> None:
    """On the true car: a third of the slip itself, within two deviations as often as it claims."""
    ukf()
    squares, slips, inside = [], [], []
    for seed in range(2):
        env: Any = EstimateObservation(gym.make(VISION, **FIG7), UKF, vehicle="truth")
        _, info = env.reset(seed=seed, options={"duration": 2.0})
        over = False
        while not over:
            *_, over, info = env.step(STILL)
            if info["t"] > 0.5:
                error = info["beta_hat"] - info["beta"]
                squares.append(error**2)
                slips.append(info["beta"] ** 2)
                inside.append(abs(error) < 2.0 * info["beta_std"])
    assert np.mean(squares) < 0.1 * np.mean(slips)
    assert np.mean(inside) > 0.9
    assert info["beta_std"] < 3.0 * np.sqrt(np.mean(squares))  # and not for being afraid


def ours(**arguments: Any) -> Any:
    return make_estimator("exact-kf", q_beta=1e-3, **arguments)


def test_ours_through_each_door_has_the_same_bits() -> None:
    """By name, by a factory or its entry point, and as an object."""
    options = {"q_beta": 1e-3}
    expected = drive(EstimateObservation(gym.make(VISION), "exact-kf", options=options), 20)
    base: Any = gym.make(VISION).unwrapped
    setup = {"vehicle": base.nominal, "sensors": base.slow_sensors, "dt": base.dt}
    built: EstimatorLike = ours(**setup)  # whose type has what the protocol asks for
    for source in (ours, functools.partial(ours), built, f"{__name__}:ours"):
        same_bits(drive(EstimateObservation(gym.make(VISION), source), 20), expected)
    disguised = ForeignEstimator(ours(**setup), "disguised", base.dt, base.slow_sensors)
    for one, other in zip(
        drive(EstimateObservation(gym.make(VISION), disguised), 20), expected, strict=True
    ):  # not compiled: all but the last bits of the nees
        assert one[0].tobytes() == other[0].tobytes()
        assert one[-1].pop("nees") == pytest.approx(other[-1]["nees"], rel=1e-9)
        assert one[-1].items() <= other[-1].items()


def test_it_gets_the_whole_record_and_what_the_env_offers() -> None:
    """Every tick once and in order, every packet, the clocks drawn at the reset; as copies."""
    env: Any = gym.make(VISION, camera={"phase": None}, control_period=7)
    wrapped: Any = EstimateObservation(
        env, Constant, outputs=["gamma", "mu"], vehicle=COMS.scale_stiffness(0.8),
        options={"gain": 3},
    )  # fmt: skip
    base, records = env.unwrapped, []
    for seed in (1, 2):
        wrapped.reset(seed=seed)
        own = wrapped.estimator.inner
        assert own.calls[0] == ("reset", base.slow_sensors, 0)
        records = [base.record]
        for _ in range(12):
            wrapped.step(STILL)
            records.append(base.record)
        steps = own.calls[1:]
        for part in (0, 1):
            found = np.concatenate([each[part] for each in steps])
            whole = np.concatenate([(each.fast, each.packets)[part] for each in records])
            assert bits(found) == bits(whole)
    own.calls[-1][0][:] = np.nan
    assert np.isfinite(base.rows).all()
    told = own.arguments
    assert told["vehicle"] == COMS.scale_stiffness(0.8) and told["gain"] == 3
    assert (told["dt"], told["speed"]) == (base.dt, base.held_speed)


def test_states_have_units_and_bounds_and_stand_by_name() -> None:
    """beta need not be the first; a state that ours do not have is a bare number."""
    env: Any = EstimateObservation(
        gym.make(VISION), Constant((0.8, 20.0, 0.1)), outputs=["mu", "gamma"], replace=True
    )
    obs, info = env.reset(seed=0)
    assert [entry[:2] for entry in env.layout[:2]] == [("mu_hat", "-"), ("gamma_hat", "rad/s")]
    assert (
        obs.tolist() == np.array([0.8, 10.0, 0.2, 0.1], np.float32).tolist()
    )  # 20 rad/s is out of bounds
    assert (info["beta_hat"], info["beta_std"]) == (0.1, pytest.approx(0.01))
    assert info["nees"] == pytest.approx(((20.0 - info["gamma"]) / 0.1) ** 2)
    blind: Any = EstimateObservation(gym.make(VISION), Constant(), outputs=["mu"])
    assert "nees" not in blind.reset(seed=0)[1]
    turned = Constant((4.0, 200.0, 0.0))
    turned.names = ("psi", "y_l", "X")
    env = EstimateObservation(gym.make(VISION), turned, outputs=["psi"], std=False, replace=True)
    assert env.reset(seed=0)[0].tolist() == np.array([4.0 - 2.0 * np.pi], np.float32).tolist()


def test_a_nan_is_passed_on_and_ends_the_episode_as_with_ours() -> None:
    env: Any = gym.make(VISION, on_bad_action="fail")
    own = Constant()
    wrapped: Any = EstimateObservation(env, own)
    agent = make_agent("two-dof", wrapped)
    obs, _ = wrapped.reset(seed=0)
    wrapped.step(agent.predict(obs)[0])
    own.value = (0.8, 0.2, np.nan)
    obs, *_, info = wrapped.step(agent.predict(obs)[0])
    assert np.isnan(obs[-4]) and obs[-3] == np.float32(0.2) and np.isnan(info["beta_hat"])
    *_, terminated, _, info = wrapped.step(agent.predict(obs)[0])
    assert terminated and info["failure"]


@pytest.mark.parametrize("source", [UKF, "object", "exact-kf"])
def test_snapshots_and_copies_continue_bit_for_bit(source: Any) -> None:
    name, ticks = (VISION, 8) if source != "exact-kf" else ("sideslip/YawVisionUneven-v0", 25)
    if source == "object":
        base: Any = gym.make(VISION).unwrapped
        own: Any = ukf()
        source = own(vehicle=COMS, sensors=base.slow_sensors, dt=base.dt, speed=None)
    elif source == UKF:
        ukf()
    env: Any = EstimateObservation(gym.make(name), source)
    drive(env, ticks)
    snapshot, twin = env.get_state(), copy.deepcopy(env)
    once = [env.step(STILL) for _ in range(15)]
    env.reset(seed=9)
    for _ in range(2):  # a snapshot serves more than once
        env.set_state(snapshot)
        same_bits([env.step(STILL) for _ in range(15)], once)
    same_bits([twin.step(STILL) for _ in range(15)], once)


def test_a_spec_names_what_can_be_imported() -> None:
    """A registered name, an entry point, a class: one JSON string builds the same env."""
    register_estimator("constant", Constant)
    for source, name in (("constant", "constant"), (CONSTANT, CONSTANT), (Constant, CONSTANT)):
        env: Any = EstimateObservation(gym.make(VISION), source, options={"value": (1.0, 2.0, 3.0)})
        text = env.spec.to_json()
        assert json.loads(text)["additional_wrappers"][0]["kwargs"]["estimator"] == name
        again: Any = gym.make(EnvSpec.from_json(text))
        same_bits(drive(again, 3), drive(env, 3))
        assert again.spec.to_json() == text


def test_a_spec_of_anything_else_is_no_json() -> None:
    local: Any = EstimateObservation(gym.make(VISION), lambda **_: Constant())
    assert isinstance(gym.make(local.spec), EstimateObservation)  # in this process it will do
    built: Any = EstimateObservation(gym.make(VISION), Constant())
    for env in (local, built):
        with pytest.raises(TypeError, match="not JSON serializable"):
            env.spec.to_json()
    with pytest.raises(TypeError, match="cannot build Constant once more: it was passed as an obj"):
        gym.make(built.spec)


def test_it_can_be_tuned() -> None:
    """By its own options; a smaller error of the sideslip angle is a smaller number."""
    ukf()
    pytest.importorskip("optuna")
    from sideslip.benchmarks.tuning.estimator import _compute_squares, make_estimator_tuning

    search: dict[str, Any] = {"gyro": None}
    task = make_estimator_tuning(UKF, "tie-vision-fig7", search=search, seeds=1)
    assert (task.unit, task.env_id) == ("rad", VISION)
    log = rollout(gym.make(VISION, **FIG7), seed=3, options={"duration": 2.05}).log
    base: Any = gym.make(VISION, **FIG7).unwrapped
    drives = [LoggedEpisode(log, make_filter_arguments(base))]
    fine, coarse = (_compute_squares(task, drives, {"gyro": sd}) for sd in (0.005, 1.0))
    assert fine < coarse
    with pytest.raises(ValueError, match="has no process noise to search; name the options"):
        make_estimator_tuning(UKF, "tie-vision-fig7", seeds=1)
