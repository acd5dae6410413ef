"""A network's correction of a filter's sideslip angle: the sum, its deviation, and when."""

import functools
import itertools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents.rollout import rollout
from sideslip.envs.record import FAST, Log
from sideslip.envs.sensors.slow import SENSOR_SETS
from sideslip.envs.vehicle.parameters import COMS
from sideslip.estimators import EstimateObservation, make_estimator, vector
from sideslip.estimators.learned.correction import (
    FRAME_TICKS,
    RING_FRAMES,
    LearnedEstimator,
    learned,
)
from sideslip.estimators.learned.correction_file import (
    FAST_INPUTS,
    LAGS,
    Correction,
    CorrectionCard,
    list_shipped,
    load_correction,
)
from sideslip.estimators.learned.network import Network

ID = "sideslip/YawFusion-v0"
READ = ("beta", "gamma", "F_d", "N_d")
SENSORS = SENSOR_SETS["fusion"]


def correction(base: str = "exact-kf", states: tuple[str, ...] = READ, seed: int = 0) -> Correction:
    """One that learned nothing: small random weights."""
    card, rng = CorrectionCard(base=base, states=states), np.random.default_rng(seed)
    sizes = [card.inputs, 16, 8, 2]
    weights = [rng.normal(size=(b, a)) / a**0.5 for a, b in itertools.pairwise(sizes)]
    weights[-1][0] *= 0.01
    biases = [0.1 * rng.normal(size=size) for size in sizes[1:]]
    biases[-1][1] = -4.0
    plain = 0.1 * rng.normal(size=card.inputs), rng.uniform(0.5, 1.0, card.inputs)
    return Correction(card, Network(*plain, weights, biases, "relu", clip=3.0))


FACTORY = functools.partial(learned, file=correction())


@pytest.fixture(scope="module")
def log() -> Log:
    """1.2 s of a random drive with both slow sensors."""
    return rollout(gym.make(ID, scenario="coms-random"), seed=3, options={"duration": 1.2}).log


def filtered(log: Log, source: Any, **options: Any) -> tuple[Any, Any]:
    """(estimator, estimates) on a log."""
    car: dict[str, Any] = {"vehicle": COMS, "sensors": log.slow}
    estimator = make_estimator(source, **car, **options)
    return estimator, estimator.run(log)


def frame(fast: Any, own: Any, tick: int) -> Any:
    """Written out slowly: means over a pace, the filter's states at its end, the car's mass."""
    rows = fast[max(tick - FRAME_TICKS + 1, 0) : tick + 1]
    v = rows[:, [FAST.wheel_left, FAST.wheel_right]].mean(axis=1)
    rate = rows[:, FAST.accel_y] / np.maximum(v, 1.0) - rows[:, FAST.gyro]
    means = [rows[:, getattr(FAST, name)].mean() for name in FAST_INPUTS]
    std = own.std[tick, own.names.index("beta")]
    return [rate.mean(), *means, *(own[name][tick] for name in READ), std, COMS.mass]


def corrected(frames: list[Any]) -> Any:
    """(shift, deviation) of a history of frames, before which there were more like the first."""
    stack = [frames[max(len(frames) - 1 - lag, 0)] for lag in LAGS]
    (shift, logarithm), *_ = correction().network(np.concatenate(stack)[None])
    return shift, np.exp(logarithm)


def test_it_is_the_network_on_frames_of_the_last_tenths_of_a_second(log: Log) -> None:
    """Of its lags, the sum held until the next pace; other states are the filter's bit for bit."""
    _, own = filtered(log, "exact-kf", slow=["camera", "gps"])
    _, found = filtered(log, FACTORY)
    fast = log.record.fast
    frames, shift, deviation = [], 0.0, 0.0
    for tick in range(len(fast)):
        if tick % FRAME_TICKS == 0:
            frames.append(frame(fast, own, tick))
            shift, deviation = corrected(frames)
        assert found["beta"][tick] == pytest.approx(own["beta"][tick] + shift, abs=1e-11), tick
        assert found.std[tick, 0] == pytest.approx(deviation, rel=1e-9)
    assert len(frames) > RING_FRAMES
    assert np.array_equal(found.x[:, 1:], own.x[:, 1:])
    assert np.array_equal(found.std[:, 1:], own.std[:, 1:])


@pytest.mark.parametrize("name", ["", *list_shipped()])
def test_torch_computes_what_numpy_does(name: str) -> None:
    torch = pytest.importorskip("torch")
    network = (load_correction(name) if name else correction()).network
    x = network.mean + np.random.default_rng(1).normal(size=(50, network.inputs))
    z = torch.tensor(
        np.clip((x - network.mean) * network.scale, -(network.clip or 0.0), network.clip)
    )
    for i, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        z = torch.nn.functional.linear(torch.relu(z) if i else z, *map(torch.tensor, (W, b)))
    assert np.allclose(z.numpy(), network(x), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("control_period", [1, 7, 10, 33])
def test_the_estimate_of_a_tick_is_the_same_for_every_control_period(
    log: Log, control_period: int
) -> None:
    _, every = filtered(log, FACTORY)
    built, _ = filtered(log, FACTORY)
    record, ends = log.record, np.searchsorted(log.record.packets[:, 2], log.record.ticks, "right")
    built.reset(log.slow, 0)
    at = begun = 0
    for end in [1, *range(1 + control_period, len(record.fast), control_period)]:
        arrived = int(ends[end - 1])
        built.step(record.fast[at:end], record.packets[begun:arrived])
        at, begun = end, arrived
        assert np.array_equal(built.x, every.x[end - 1])
        assert np.array_equal(np.sqrt(np.diag(built.P)), every.std[end - 1])


@pytest.mark.parametrize("name", list_shipped())
@pytest.mark.parametrize("control_period", [1, 7, 10])
def test_an_observation_is_what_numpy_makes_of_the_estimate(name: str, control_period: int) -> None:
    """One compiled call takes the step and writes: here the filter's twin takes it, and NumPy."""
    outputs = ("gamma", "beta", "F_d")
    env: Any = gym.make(ID, scenario="coms-slalom", control_period=control_period)
    wrapped = EstimateObservation(env, f"learned-{name}", outputs, replace=True)
    obs, info = wrapped.reset(seed=2)
    base = env.unwrapped
    car: dict[str, Any] = {"vehicle": base.nominal, "sensors": base.slow_sensors}
    twin: Any = make_estimator(f"learned-{name}", **car)
    columns = [twin.names.index(state) for state in outputs]
    for _ in range(60):
        twin.step(base.rows[: base.ticks_done], base.packets[: base.delivered])
        x, P = twin.x[columns], twin.P[np.ix_(columns, columns)]
        assert obs.tobytes() == np.array([*x, *np.sqrt(np.diag(P))], np.float32).tobytes()
        assert (info["beta_hat"], info["beta_std"]) == (x[1], np.sqrt(P[1, 1]))
        e = x[:2] - [info["gamma"], info["beta"]]
        assert info["nees"] == pytest.approx(e @ np.linalg.solve(P[:2, :2], e) / 2.0, rel=1e-9)
        assert twin.x[0] != twin.inner.base.x[0]
        obs, *_, info = wrapped.step(np.full(1, 0.2, np.float32))


@pytest.mark.parametrize("base", ["exact-kf", "joint"])
def test_a_row_of_a_vector_env_has_the_single_envs_bits(base: str) -> None:
    source = functools.partial(learned, file=correction(base))
    options: dict[str, Any] = {"scenario": "coms-slalom", "control_period": 15}
    rows = vector.EstimateObservation(gym.make_vec(ID, 3, **options), source)
    single = EstimateObservation(gym.make(ID, **options), source)
    (found, infos), (expected, info) = rows.reset(seed=4), single.reset(seed=6)
    for _ in range(40):
        assert found[2].tobytes() == expected.tobytes()
        assert infos["nees"][2] == info["nees"]
        found, *_, infos = rows.step(np.full((3, 1), 0.2, np.float32))
        expected, *_, info = single.step(np.full(1, 0.2, np.float32))
    own: Any = single.estimator
    assert rows.estimator[2].x[0] == own.x[0] != own.inner.base.x[0]


def test_a_snapshot_goes_on_with_the_same_bits() -> None:
    for env in (
        EstimateObservation(gym.make(ID), FACTORY),
        vector.EstimateObservation(gym.make_vec(ID, 2), FACTORY),
    ):
        action: Any = np.zeros(env.action_space.shape, np.float32)
        env.reset(seed=1)
        for _ in range(7):
            env.step(action)
        snapshot: Any = env.get_state()
        once = [env.step(action)[0] for _ in range(20)]
        env.set_state(snapshot)
        assert np.array_equal([env.step(action)[0] for _ in range(20)], once)


def test_a_number_that_is_not_finite_drops_the_correction_and_its_history(log: Log) -> None:
    """The roll rate, which this filter does not read: beta is then the filter's own, until a whole
    frame is there again, which has no older ones before it."""
    broken, frames = log.record.fast.copy(), []
    broken[505, FAST.roll_rate] = np.nan
    _, own = filtered(log, "exact-kf", slow=["camera", "gps"])
    estimator = make_estimator(FACTORY, vehicle=COMS, sensors=log.slow)
    for tick, row in enumerate(broken):
        arrived = log.record.packets[log.record.packets[:, 2] == tick]
        estimator.step(row[None], arrived)
        without = np.array_equal(estimator.x, own.x[tick])
        assert without == (510 <= tick < 520), tick
        assert np.isfinite(estimator.x).all() and np.isfinite(estimator.P).all()
        if tick >= 520 and tick % FRAME_TICKS == 0:
            frames.append(frame(broken, own, tick))
            shift, _ = corrected(frames)
            assert estimator.x[0] == pytest.approx(own["beta"][tick] + shift, abs=1e-11), tick


def test_the_sum_varies_with_no_other_state(log: Log) -> None:
    """How its error depends on theirs is not known; theirs are the filter's bit for bit."""
    base, _ = filtered(log, "exact-kf", slow=["camera", "gps"])
    P, own = filtered(log, FACTORY)[0].P, base.P
    assert own[0, 1:].any() and not P[0, 1:].any() and not P[1:, 0].any()
    assert np.array_equal(P[1:, 1:], own[1:, 1:])


def test_what_it_was_not_trained_on_is_refused() -> None:
    base = make_estimator("exact-kf", sensors=SENSORS)
    with pytest.raises(ValueError, match=r"was trained on joint with beta.* this is exact-kf"):
        LearnedEstimator(base, correction("joint"), COMS)
    with pytest.raises(ValueError, match=r"with beta, front_tyres and ticks.*this is exact-kf"):
        LearnedEstimator(base, correction(states=("beta", "front_tyres")), COMS)
    with pytest.raises(ValueError, match=r"ticks of 0.001 s.*ticks of 0.01 s"):
        make_estimator(FACTORY, sensors={"gps": SENSORS["gps"]}, dt=0.01)
    with pytest.raises(TypeError, match="unknown option"):
        make_estimator(FACTORY, sensors=SENSORS, depth=3)
