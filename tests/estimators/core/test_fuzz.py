"""Bad packets leave no trace but a count: the filter is the one that saw only the good ones."""

from collections import Counter
from typing import Any

import numpy as np
import pytest

from sideslip.envs.record import FAST, FAST_WIDTH, PACKET, PACKET_WIDTH, Record
from sideslip.envs.sensors.link import SlowSensor
from sideslip.envs.sensors.slow import SLOW_NAMES
from sideslip.estimators import make_estimator

HUGE = 1e300  # finite, and no int64


def good_packets(rng: Any, sensors: dict[int, SlowSensor], rows: int) -> Any:
    """Packets by arrival, some of them lost. sensors: by code."""
    found: Any = []
    for s, sensor in sensors.items():
        for i, k in enumerate(range(0, rows, round(1e3 * sensor.period))):
            late = round(1e3 * sensor.delays[i % len(sensor.delays)])
            late += int(rng.integers(0, round(1e3 * sensor.jitter) + 1))
            if rng.random() < 0.9 and k + late < rows:
                row = np.zeros(PACKET_WIDTH)
                row[: PACKET.value] = s, k, k + late, 1.0, i
                row[PACKET.value :] = *(0.02 * rng.standard_normal(2)), 0.0, 0.0, 1.5, 9.0
                if s == 1:
                    row[PACKET.value + 1] = 7.0
                found.append(row)
    packets = np.array(found)
    return packets[np.lexsort((packets[:, 0], packets[:, 1], packets[:, 2]))]


def _spoilt(rng: Any, row: Any, kind: str, now: int, period: int, rows: int) -> None:
    """Make a good packet that is here at tick `now` a bad one, in place."""
    header = int(rng.integers(0, PACKET.value + 1))  # or its first value
    old = max(period * ((now - 600) // period), 0) if now >= 600 else -period
    row[PACKET.captured], row[PACKET.arrived] = now // period * period, now
    if kind == "nan":
        row[header] = np.nan
    elif kind == "inf":
        row[header] = rng.choice([np.inf, -np.inf])
    elif kind == "huge":
        row[rng.choice([0, 1, 2, 5])] = rng.choice([HUGE, -HUGE, 1e19, -1e19])
    elif kind == "sensor":
        row[PACKET.sensor] = rng.choice([-1.0, 2.0, 7.0, 0.5, 1e9, -1e9])
    elif kind == "future capture":
        row[PACKET.captured] = row[PACKET.arrived] = now // period * period + period
        row[PACKET.arrived] += rows
    elif kind == "future arrival":
        row[PACKET.arrived] = rows + int(rng.integers(0, 10**6))
    elif kind == "old":
        row[PACKET.captured] = old
    elif kind == "negative":
        row[PACKET.captured] = -period * int(rng.integers(1, 10**6))
    elif kind == "arrived before":
        row[PACKET.arrived] = row[PACKET.captured] - int(rng.integers(1, 100))
    elif kind == "fraction":
        row[rng.choice([1, 2])] -= 0.5
    elif kind == "off clock":
        row[PACKET.captured] = max(row[PACKET.captured] - int(rng.integers(1, period)), 1)
    elif kind == "quality":
        row[PACKET.quality] = rng.choice([0.0, -1.0, -1e9])
    elif kind == "satellites":
        row[PACKET.value + 5] = rng.choice([1.0, 2.0, 3.0])


KINDS = (
    "nan", "inf", "huge", "sensor", "future capture", "future arrival", "old", "negative",
    "arrived before", "fraction", "off clock", "quality", "satellites", "twice",
)  # fmt: skip


def mixed(
    rng: Any, good: Any, sensors: dict[int, SlowSensor], rows: int, count: int, kinds: Any
) -> Any:
    """(packets, kind of each; "" is good): `count` bad ones at random ticks among the good."""
    bad, said, here = np.zeros((count, PACKET_WIDTH)), [], np.sort(rng.integers(0, rows, count))
    place = np.zeros(count)  # among the good ones
    due = good[:, PACKET.arrived]
    for i, now in enumerate(here):
        s = int(rng.choice(list(sensors)))
        period = round(1e3 * sensors[s].period)
        past = int(np.searchsorted(due, now, "right"))  # good ones that have come
        kind = str(rng.choice(kinds))
        if kind == "satellites" and s != 1:
            kind = "quality"
        if kind == "twice" and past == 0:
            kind = "nan"
        if kind == "off clock" and now < period:
            kind = "fraction"
        bad[i] = good[int(rng.integers(0, len(good)))]
        bad[i, PACKET.sensor] = s
        bad[i, PACKET.value : PACKET.value + 2] = 5.0 * rng.standard_normal(2)
        if kind == "twice":
            bad[i, : PACKET.value] = good[int(rng.integers(0, past)), : PACKET.value]
            bad[i, PACKET.arrived] = now
        else:
            _spoilt(rng, bad[i], kind, int(now), period, rows)
        said.append(kind)
        first = int(np.searchsorted(due, now, "left"))
        place[i] = past if kind == "twice" else rng.integers(first, past + 1)
    order = np.argsort(np.concatenate([np.arange(len(good)) + 0.5, place]), kind="stable")
    kinds_of = np.array([""] * len(good) + said)
    return np.concatenate([good, bad])[order], kinds_of[order]


def record_of(rng: Any, packets: Any, rows: int) -> Record:
    """With fast rows of a car at 7 m/s."""
    fast = np.zeros((rows, FAST_WIDTH))
    fast[:, FAST.gyro] = 0.05 * rng.standard_normal(rows)
    fast[:, FAST.steer] = 0.02 * rng.standard_normal(rows)
    fast[:, FAST.wheel_left] = fast[:, FAST.wheel_right] = 7.0
    return Record(fast, packets)


pytestmark = pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")

ROWS = 3000
UNEVEN = SlowSensor(0.033, (0.020, 0.015, 0.010, 0.025))
CAMERA = SlowSensor(0.033, (0.010,), jitter=0.060)
GPS = SlowSensor(0.2, (0.060,), jitter=0.100)
STEADY = SlowSensor(0.2, (0.060,))

FILTERS: Any = {
    "clone": ("exact-kf", {0: CAMERA, 1: GPS}, {}),
    "buffer": ("exact-kf", {0: CAMERA, 1: GPS}, {"delay": "buffer"}),
    "stored": ("exact-kf", {0: CAMERA, 1: GPS}, {"delay": "stored"}),
    "ignore": ("exact-kf", {0: CAMERA, 1: GPS}, {"delay": "ignore"}),
    "larsen": ("exact-kf", {0: UNEVEN}, {"delay": "larsen"}),
    "gate": ("exact-kf", {0: CAMERA, 1: GPS}, {"gate": 0.9999}),
    "adapt": ("exact-kf", {0: CAMERA, 1: GPS}, {"adapt": 0.05}),
    "periodic": ("multirate-kf", {0: UNEVEN}, {}),
    "pseudo-residual": ("multirate-residual-kf", {1: STEADY}, {}),
    "uneven-delay": ("uneven-delay-kf", {0: UNEVEN}, {}),
    "constant-delay": ("constant-delay-kf", {0: UNEVEN}, {}),
    "dakf": ("dakf", {1: GPS}, {}),
    "double-layer": ("double-layer", {1: GPS}, {}),
    "double-layer, predicted": ("double-layer", {1: GPS}, {"intersample": "predict"}),
    "double-layer, buffer": (
        "double-layer",
        {1: GPS},
        {"intersample": "predict", "delay": "buffer"},
    ),
    "dual-rate": ("dual-rate", {1: SlowSensor(0.2)}, {"delay": "ignore"}),
}
HARD = ("clone", "buffer", "stored", "larsen", "pseudo-residual", "double-layer")


def built(key: str) -> Any:
    name, sensors, options = FILTERS[key]
    slow = {SLOW_NAMES[s]: sensor for s, sensor in sensors.items()}
    return make_estimator(name, sensors=slow, slow=list(slow), speed=7.0, **options)


def hold(key: str, count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    sensors, filter_ = FILTERS[key][1], built(key)
    kinds = [kind for kind in KINDS if kind != "off clock" or "buffer" not in key]
    if key in ("ignore", "constant-delay", "dual-rate"):  # these look at no age
        kinds.remove("old")
    good = good_packets(rng, sensors, ROWS)
    packets, said = mixed(rng, good, sensors, ROWS, count, kinds)
    record = record_of(rng, good, ROWS)
    alone = filter_.run(record)
    improbable = filter_.counts["gated"]  # these values are no car's
    assert sum(filter_.counts.values()) == improbable < len(good) > 10
    memory = filter_.get_state()
    among = filter_.run(Record(record.fast, packets))
    assert set(said) >= set(kinds) - {"satellites"}  # every kind came
    assert sum(filter_.counts.values()) == count + improbable
    np.testing.assert_array_equal(among.x, alone.x)
    np.testing.assert_array_equal(among.std, alone.std)
    assert np.isfinite(among.x).all() and np.isfinite(among.std).all()
    np.testing.assert_array_equal(filter_.filters["P"], memory["P"])
    np.testing.assert_array_equal(filter_.filters["scale"], memory["scale"])
    assert np.isnan(among.nis[said != ""]).all()
    np.testing.assert_array_equal(among.nis[said == ""], alone.nis)


@pytest.mark.parametrize("key", FILTERS)
def test_bad_packets_leave_no_trace_but_a_count(key: str) -> None:
    hold(key, 1_500, 1)


@pytest.mark.long
@pytest.mark.parametrize("key", HARD)
def test_nor_do_a_hundred_thousand(key: str) -> None:
    hold(key, 100_000, 2)


COUNTER = {
    "nan": "invalid",
    "inf": "invalid",
    "huge": "invalid",
    "sensor": "unknown",
    "future capture": "future",
    "future arrival": "future",
    "negative": "refused",
    "arrived before": "unknown",
    "fraction": "unknown",
    "off clock": "unknown",
    "quality": "poor",
    "satellites": "poor",
}


@pytest.mark.parametrize("kind", COUNTER)
def test_each_kind_has_its_counter(kind: str) -> None:
    rng = np.random.default_rng(3)
    key = "double-layer" if kind == "satellites" else "clone"
    sensors, filter_ = FILTERS[key][1], built(key)
    good = good_packets(rng, sensors, ROWS)
    packets, said = mixed(rng, good, sensors, ROWS, 400, [kind])
    filter_.run(record_of(rng, packets, ROWS))
    count = Counter(said.tolist())[kind]
    assert filter_.counts[COUNTER[kind]] >= count > 300
    assert sum(filter_.counts.values()) == 400


def test_an_old_stamp_is_refused_or_known_as_a_second_copy() -> None:
    rng = np.random.default_rng(3)
    sensors, filter_ = FILTERS["clone"][1], built("clone")
    packets, _ = mixed(rng, good_packets(rng, sensors, ROWS), sensors, ROWS, 400, ["old"])
    filter_.run(record_of(rng, packets, ROWS))
    assert (
        filter_.counts["refused"] > 200
        and filter_.counts["refused"] + filter_.counts["duplicates"] == 400
    )


def test_the_second_copy_is_the_duplicate_whatever_came_between() -> None:
    """Each packet once more, and again, much later, in any order."""
    for key in ("clone", "buffer", "stored", "larsen", "ignore"):
        rng = np.random.default_rng(4)
        filter_ = built(key)
        good = good_packets(rng, FILTERS[key][1], ROWS)
        record = record_of(rng, good, ROWS)
        alone = filter_.run(record).x[-1].copy()
        for i in rng.permutation(np.repeat(np.arange(len(good)), 2)):
            copy = good[i].copy()
            copy[PACKET.value] += 1.0
            filter_.update(copy)
        assert filter_.counts["duplicates"] + filter_.counts["refused"] == 2 * len(good)
        assert filter_.counts["duplicates"] >= 16
        np.testing.assert_array_equal(filter_.x, alone)


def test_one_packet_at_a_time_is_judged_alike() -> None:
    """`predict` and `update`, as a live car calls them."""
    rng = np.random.default_rng(5)
    sensors, filter_ = FILTERS["clone"][1], built("clone")
    good = good_packets(rng, sensors, 400)
    packets, said = mixed(rng, good, sensors, 400, 2000, KINDS)
    record = record_of(rng, good, 400)
    alone = filter_.run(record)
    filter_.reset()
    at, found = 0, []
    for k, row in enumerate(record.fast):
        filter_.predict(row)
        while at < len(packets) and not (said[at] == "" and packets[at, PACKET.arrived] > k):
            filter_.update(packets[at])
            at += 1
        found.append(filter_.x)
    assert sum(filter_.counts.values()) == 2000
    np.testing.assert_array_equal(np.array(found), alone.x)


def test_a_speed_that_is_none_is_bad_for_the_second_layer_alone() -> None:
    """The course is used; what is not is counted."""
    rng = np.random.default_rng(6)
    filter_ = built("double-layer")
    packets = good_packets(rng, {1: GPS}, ROWS)
    record = record_of(rng, packets, ROWS)
    filter_.run(record)
    first = filter_.filters[0].x.copy()
    packets[5:, PACKET.value + 1] = np.nan
    found = filter_.run(record)
    assert filter_.counts["invalid"] == len(packets) - 5
    np.testing.assert_array_equal(filter_.filters[0].x, first)
    assert np.isfinite(found.x).all()


@pytest.mark.parametrize("column", range(9))
def test_a_fast_sample_beyond_all_measure_is_none(column: int) -> None:
    rng = np.random.default_rng(7)
    filter_ = make_estimator("exact-kf", sensors={"camera": CAMERA})
    record = record_of(rng, good_packets(rng, {0: CAMERA}, 500), 500)
    record.fast[100, column] = 1e300
    found = filter_.run(record)
    assert np.isfinite(found.x).all() and np.abs(found.x).max() < 1e3
