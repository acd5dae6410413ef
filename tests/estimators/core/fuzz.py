"""Random bad packets of every kind, mixed with good ones."""

from typing import Any

import numpy as np

from sideslip.envs.record import FAST, FAST_WIDTH, PACKET, PACKET_WIDTH, Record
from sideslip.envs.sensors.link import SlowSensor

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
