"""All randomness of an episode hangs on one 64-bit key."""

import numpy as np
import pytest

from sideslip.envs import StabilityEnv
from sideslip.envs.engine.layout import Z
from sideslip.envs.record import FAST

from ..helpers import IDS, LINEAR, SILENT, bits, fast_rows, play, unwrapped

pytestmark = pytest.mark.plain


def key(env: StabilityEnv) -> tuple[int, int]:
    low, high = env.get_state()["state"][[Z.clock.key_low, Z.clock.key_high]]
    return int(low), int(high)


@pytest.mark.smoke
@pytest.mark.parametrize("name", IDS)
def test_a_reset_draws_exactly_one_64_bit_number(name: str) -> None:
    env, alone = unwrapped(name), np.random.default_rng(np.random.SeedSequence(9))
    for episode in range(4):
        env.reset(seed=9 if episode == 0 else None)
        drawn = int(alone.integers(0, 2**64, dtype=np.uint64))
        assert key(env) == (drawn & 0xFFFFFFFF, drawn >> 32)
        play(env, [0.1] * 30)  # steps draw nothing
    assert env.np_random.bit_generator.state == alone.bit_generator.state


def test_options_do_not_change_how_much_is_drawn() -> None:
    env, plain = StabilityEnv(), StabilityEnv()
    env.reset(seed=3, options={"scenario": "gust", "friction": 0.5, "vehicle": "passenger-car"})
    plain.reset(seed=3)
    assert key(env) == key(plain)
    assert bits(env.reset()) == bits(plain.reset())


def test_nothing_random_depends_on_what_the_car_does() -> None:
    """Sensor noise is the same number at the same tick, whatever was done before."""
    noisy = [StabilityEnv(scenario=LINEAR | {"noise": {}}) for _ in range(2)]
    quiet = [StabilityEnv(scenario=LINEAR) for _ in range(2)]
    noises = []
    for one, other, action in zip(noisy, quiet, (0.0, 0.7), strict=True):
        one.reset(seed=1)
        other.reset(seed=1)
        with_noise = fast_rows(play(one, [action] * 50))
        noises.append(with_noise - fast_rows(play(other, [action] * 50)))
    # differences of numbers up to 10: their roundings
    np.testing.assert_allclose(noises[0], noises[1], rtol=0.0, atol=1e-14)
    assert np.abs(noises[0][:, FAST.gyro]).max() > 0.005


def test_a_sensor_more_or_less_shifts_no_other() -> None:
    """The camera's clock, loss and noise, and the GPS in its place, leave the rest alone."""
    rows = []
    for env in (
        StabilityEnv("vision"),
        StabilityEnv("vision", camera={"period": 0.02, "loss": 0.5, "phase": None}),
        StabilityEnv("gps"),
    ):
        env.reset(seed=2)
        rows.append(bits(fast_rows(play(env, [0.3] * 50))))
    assert rows[0] == rows[1] == rows[2]


def test_noise_of_another_size_moves_no_other_draw() -> None:
    rows = []
    for noise in (SILENT, SILENT | {"gyro": 0.01}):
        env = StabilityEnv(scenario={"base": "random-steering", "noise": noise})
        env.reset(seed=2)
        rows.append(fast_rows(play(env, [0.3] * 50)))
    np.testing.assert_array_equal(rows[0][:, 1:], rows[1][:, 1:])
    assert np.all(rows[0][:, FAST.gyro] != rows[1][:, FAST.gyro])


def test_neighbouring_seeds_and_episodes_share_nothing() -> None:
    env, keys, speeds = StabilityEnv(), set(), set()
    for seed in range(200):
        env.reset(seed=seed)
        keys.add(key(env))
        speeds.add(env.get_state()["state"][Z.motion.v_x])
        env.reset()
        keys.add(key(env))
    assert len(keys) == 400
    assert len(speeds) == 200


@pytest.mark.compiled
def test_the_disturbance_starts_and_stays_stationary() -> None:
    """50 N and 20 N m at every tick, over many episodes."""
    env = StabilityEnv(scenario="tie-vision-fig7", control_period=50)
    samples = []
    for seed in range(400):
        env.reset(seed=seed)
        start = env.get_state()["state"][[Z.drive.F_d, Z.drive.N_d]]
        play(env, [0.0])
        samples.append([*start, *env.get_state()["state"][[Z.drive.F_d, Z.drive.N_d]]])
    values = np.array(samples) / [50.0, 20.0, 50.0, 20.0]
    # the variance of 400 normal numbers: four standard errors; so the correlation's
    assert np.all(np.abs(values.var(axis=0) - 1.0) < 4.0 * np.sqrt(2.0 / 400.0))
    mixed = np.asarray(np.corrcoef(values.T))
    kept = np.exp(-0.05 / 0.3)
    for i, j, expected in ((0, 1, 0.0), (2, 3, 0.0), (0, 2, kept), (1, 3, kept), (0, 3, 0.0)):
        assert abs(mixed[i, j] - expected) < 4.0 / np.sqrt(400.0)
