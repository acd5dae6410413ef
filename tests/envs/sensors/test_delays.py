"""A delay costs exactly what it says: ticks from capture to arrival are counted."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from scipy import stats

from sideslip.envs import SlowSensor, StabilityEnv
from sideslip.envs.record import PACKET
from sideslip.envs.scenarios.scenario import MIN_GPS_PERIOD
from sideslip.envs.sensors.link import MAX_IN_FLIGHT, make_link
from sideslip.envs.sensors.slow import CAMERA, GPS, SENSOR_SETS

from ..helpers import IDS, LINEAR, packets, play, unwrapped

CAPTURED, ARRIVED, SEQUENCE = PACKET.captured, PACKET.arrived, PACKET.sequence
ENDLESS = LINEAR | {"duration": 1000.0}
QUICK: dict[str, Any] = {"period": 0.005, "delays": [0.0]}  # many frames in little time


def received(sensors: str = "vision", ticks: int = 2000, seed: int = 0, **changes: Any) -> Any:
    """All packets of an uncontrolled drive, those of the reset included: (count, PACKET_WIDTH)."""
    n = changes.get("control_period", 10)
    env = StabilityEnv(sensors, **({"scenario": ENDLESS} | changes))
    env.reset(seed=seed)
    start = env.record
    found = [start.packets]
    for moment in play(env, [0.0] * (ticks // n)):
        rows = moment.record.ticks
        arrived = moment.record.packets[:, ARRIVED]
        # a packet is in the record of the step in which it arrives, in no other
        assert np.all((rows[0] <= arrived) & (arrived <= rows[-1]))
        found.append(moment.record.packets)
    return np.concatenate(found)


def delays(found: np.ndarray) -> list[float]:
    return list(map(float, found[:, ARRIVED] - found[:, CAPTURED]))


@pytest.mark.plain
@pytest.mark.smoke
@pytest.mark.parametrize("n", [1, 10, 33])
@pytest.mark.parametrize(
    ("sensors", "changes", "period", "late"),
    [
        ("vision", {}, 33, 30),
        ("gps", {}, 200, 0),  # from tick 0 on
        ("gps", {"gps": {"delays": [0.3]}}, 200, 300),  # longer than the period
    ],
)
def test_a_packet_is_as_late_as_is_said(
    n: int, sensors: str, changes: dict[str, Any], period: int, late: int
) -> None:
    found = received(sensors, control_period=n, **changes)
    captured = range(0, 2000 // n * n - late + 1, period)
    assert found[:, CAPTURED].tolist() == list(captured)
    assert found[:, SEQUENCE].tolist() == list(range(len(captured)))
    assert set(delays(found)) == {float(late)}
    assert set(found[:, PACKET.sensor]) == {CAMERA if sensors == "vision" else GPS}


@pytest.mark.plain
@pytest.mark.smoke
def test_uneven_delays_repeat_20_15_10_25_ms() -> None:
    found = received(scenario="uneven-delay-fig5")
    found = found[np.argsort(found[:, SEQUENCE])]
    assert found[:, SEQUENCE].tolist() == list(range(len(found)))
    expected = [(20.0, 15.0, 10.0, 25.0)[frame % 4] for frame in range(len(found))]
    assert delays(found) == expected


def test_a_jitter_reaches_both_its_ends_and_favours_nothing() -> None:
    camera = QUICK | {"delays": [0.010], "jitter": 0.020}
    late = delays(received("vision-uneven", 40_000, camera=camera, control_period=1000))
    assert set(late) == {float(ticks) for ticks in range(10, 31)}
    counts = np.unique(late, return_counts=True)[1]
    assert stats.chisquare(counts).pvalue > 1e-3  # one fixed seed: passed once and for all


@pytest.mark.plain
def test_an_outage_swallows_what_is_captured_within_it() -> None:
    outage = ENDLESS | {"gps_outage": (0.4, 1.0)}
    found = received("gps", scenario=outage, gps={"delays": [0.3]})
    assert found[:, SEQUENCE].tolist() == [0, 1, 5, 6, 7, 8]  # 0.4 s is lost, 1.0 s is not
    camera = received(scenario=ENDLESS | {"camera_outage": (0.0, 1.0)})
    assert camera[0, CAPTURED] == 31 * 33.0


@pytest.mark.parametrize(("loss", "arrived"), [(0.0, 60), (1.0, 0)])
def test_certain_loss_and_certain_arrival(loss: float, arrived: int) -> None:
    assert len(received(camera={"loss": loss})) == arrived


def test_loss_is_as_frequent_as_it_says_and_leaves_gaps_in_the_sequence() -> None:
    found = received(ticks=50_000, camera=QUICK | {"loss": 0.2}, control_period=1000)
    sent = 10_001
    lost = sent - len(found)
    # four standard deviations of the binomial law
    assert abs(lost - 0.2 * sent) < 4.0 * np.sqrt(sent * 0.2 * 0.8)
    assert np.all(found[:, CAPTURED] == 5.0 * found[:, SEQUENCE])


@pytest.mark.plain
def test_a_duplicate_repeats_everything_but_its_arrival() -> None:
    found = received(camera={"duplicate": 1.0})
    found = found[np.lexsort((found[:, ARRIVED], found[:, SEQUENCE]))]
    first, second = found[: len(found) // 2 * 2 : 2], found[1::2]
    same = [i for i in range(found.shape[1]) if i != ARRIVED]
    np.testing.assert_array_equal(first[:, same], second[:, same])
    assert set(delays(first)) == {30.0}
    later = second[:, ARRIVED] - first[:, ARRIVED]
    assert later.min() >= 1.0
    assert later.max() <= 33.0


def test_duplicates_are_as_frequent_as_they_say() -> None:
    rare = received(ticks=50_000, camera=QUICK | {"duplicate": 0.1}, control_period=1000)
    # four standard deviations of the binomial law
    assert abs(len(rare) - 1.1 * 10_001) < 4.0 * np.sqrt(10_001 * 0.1 * 0.9)


def test_phase_sets_the_clock_on() -> None:
    found = received(camera={"phase": 0.012})
    assert found[:3, CAPTURED].tolist() == [12.0, 45.0, 78.0]


def test_a_random_phase_is_drawn_at_reset_within_the_period_and_told() -> None:
    env = StabilityEnv(scenario=ENDLESS, camera={"phase": None}, control_period=100)
    seen = set()
    for seed in range(300):
        env.reset(seed=seed)
        told = env.slow_sensors["camera"].phase
        assert told is not None
        (moment,) = play(env, [0.0])
        assert moment.record.packets[0, CAPTURED] == round(1000.0 * told)
        assert env.slow_sensors["camera"].phase == told
        seen.add(round(1000.0 * told))
    assert seen == set(range(33))


@pytest.mark.parametrize("name", IDS)
def test_what_the_env_tells_about_its_sensors_is_what_happens(name: str) -> None:
    env = unwrapped(name)
    env.reset(seed=1)
    found = np.concatenate([env.record.packets, packets(play(env, [0.0] * 200))])
    for sensor, told in env.slow_sensors.items():
        own = found[found[:, PACKET.sensor] == {"camera": CAMERA, "gps": GPS}[sensor]]
        assert told.phase is not None
        frames = (own[:, CAPTURED] / 1000.0 - told.phase) / told.period
        assert frames == pytest.approx(own[:, SEQUENCE], abs=1e-12)  # roundings of 60
        assert np.all(own[:, ARRIVED] - own[:, CAPTURED] <= round(1000.0 * told.longest_delay))


@pytest.mark.plain
def test_packets_come_in_the_order_of_arrival_then_capture_then_sensor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    both: Mapping[str, SlowSensor] = {
        "camera": SlowSensor(period=0.010, delays=(0.0,), jitter=0.030),
        "gps": SlowSensor(period=0.010, delays=(0.020, 0.0, 0.010)),
    }
    monkeypatch.setitem(SENSOR_SETS, "both", dict(both))
    for n in (1, 50):
        found = received("both", 3000, control_period=n)
        keys = found[:, [ARRIVED, CAPTURED, PACKET.sensor]].tolist()
        assert keys == sorted(keys)
        assert len({tuple(key) for key in keys}) == len(keys)
        late = found[found[:, PACKET.sensor] == CAMERA][:, CAPTURED]
        assert np.any(np.diff(late) < 0.0)  # there were out-of-order ones to be put in order


CROWDED: list[dict[str, Any]] = [
    {"period": 0.010, "delays": [0.079]},
    {"period": 0.010, "delays": [0.010, 0.0], "jitter": 0.009, "duplicate": 1.0},
    {"period": 0.001, "delays": [0.007]},
    {"period": 0.001, "delays": [0.001], "duplicate": 1.0},
    {"period": 0.020, "delays": [0.0], "jitter": 0.059, "duplicate": 1.0},
]


@pytest.mark.parametrize("camera", CROWDED, ids=str)
@pytest.mark.parametrize("n", [1, 10, 1000])
def test_there_is_room_for_the_worst_case(camera: dict[str, Any], n: int) -> None:
    found = received(ticks=4000, camera=camera, control_period=n)
    copies = 2 if "duplicate" in camera else 1
    longest = round(1000.0 * (max(camera.get("delays", [0.030])) + camera.get("jitter", 0.0)))
    period = round(1000.0 * camera["period"])
    landed = [frame for frame in range(4000) if period * frame + longest + period <= 4000]
    counts = np.bincount(found[:, SEQUENCE].astype(int), minlength=len(landed))
    assert np.all(counts[: len(landed)] == copies)


@pytest.mark.parametrize(
    "changes",
    [
        {"period": 0.010, "delays": (0.080,)},
        {"period": 0.033, "delays": (0.1,), "duplicate": 0.01},
        # each time rounds up on its own, the sum would round down to 79 ms
        {"period": 0.010, "delays": (0.0696,), "jitter": 0.0096},
    ],
)
def test_more_packets_under_way_than_there_is_room_for_are_refused(changes: Any) -> None:
    with pytest.raises(ValueError, match=rf"way at once; there is room for {MAX_IN_FLIGHT}"):
        make_link(SlowSensor(**changes))
    with pytest.raises(ValueError, match="under way"):
        StabilityEnv(camera=changes)


@pytest.mark.parametrize("n", [1, 10, 1000])
def test_a_scenario_sets_the_gps_clock_and_its_packets_have_room(n: int) -> None:
    clock = {"gps_period": MIN_GPS_PERIOD, "gps_delays": [0.12, 0.05, 0.1], "duration": 60.0}
    env = StabilityEnv("fusion", control_period=n, gps={"duplicate": 1.0})
    env.reset(seed=0, options={"scenario": LINEAR | clock})
    told = env.slow_sensors["gps"]
    assert (told.period, told.delays, told.duplicate) == (0.05, (0.12, 0.05, 0.1), 1.0)
    found = packets(play(env, [0.0] * (4000 // n)))
    gps = found[found[:, PACKET.sensor] == GPS]
    first = gps[np.unique(gps[:, SEQUENCE], return_index=True)[1]]
    assert np.array_equal(first[:, CAPTURED], 50.0 * first[:, SEQUENCE])
    late = np.array([120.0, 50.0, 100.0])[first[:, SEQUENCE].astype(int) % 3]
    assert np.array_equal(first[:, ARRIVED] - first[:, CAPTURED], late)
    counts = np.bincount(gps[:, SEQUENCE].astype(int))
    assert np.all(counts[:70] == 2)
    env.reset(seed=0)
    assert env.slow_sensors["gps"].period == 0.2
    assert StabilityEnv("vision", scenario=LINEAR | clock).slow_sensors.keys() == {"camera"}


def test_the_envs_own_clock_comes_over_the_scenarios() -> None:
    late = {"camera_delays": [0.05], "camera_jitter": 0.01, "camera_loss": 0.1}
    env = StabilityEnv("vision", scenario=LINEAR | late, camera={"delays": [0.1], "loss": 0.0})
    told = env.slow_sensors["camera"]
    assert (told.delays, told.jitter, told.loss) == ((0.1,), 0.01, 0.0)
    assert StabilityEnv("vision", scenario=LINEAR | late).slow_sensors["camera"].loss == 0.1


def test_late_stamps_have_room_under_way_or_are_refused() -> None:
    """A packet does not arrive before its stamp, so that the queue is longer than by its delay."""
    with pytest.raises(ValueError, match=r"stamps up to 0\.1 s later puts 21 packets under way"):
        StabilityEnv("gps", gps={"period": 0.005}, world={"gps_stamp": 0.1})
    env = StabilityEnv("gps", gps={"period": 0.02}, world={"gps_stamp": 0.1}, scenario="straight")
    env.reset(seed=0)
    assert all(abs(env.step([0.0])[4]["beta"]) < 0.1 for _ in range(40))


def test_no_stamp_of_a_fast_clock_lies_before_tick_0() -> None:
    env = StabilityEnv("gps", gps={"period": 0.02}, world={"gps_stamp": (-0.05, 0.0)})
    for seed in range(20):
        env.reset(seed=seed)
        found = packets(play(env, [0.0] * 10))
        assert 0.0 <= found[:, CAPTURED].min() < 20.0
