"""Ticks follow each other whatever is lost, late, doubled or made up."""

import random

import numpy as np
import pytest

from sideslip.agents.live.messages import (
    MAX_BEHIND,
    MAX_HELD,
    Arrival,
    DatagramKind,
    RejectReason,
    StreamSynchroniser,
    Tick,
    encode,
)
from sideslip.envs.record import FAST, PACKET
from tests.agents.live.both_ends import camera, inertial


def ticks_of(assembler: StreamSynchroniser, *batch: Arrival) -> list[Tick]:
    return list(assembler.take(batch))


def numbers(ticks: list[Tick]) -> list[int]:
    return [tick.number for tick in ticks]


def test_a_row_ends_its_tick_and_packets_go_with_the_next_row() -> None:
    assembler = StreamSynchroniser()
    first, second = ticks_of(assembler, inertial(40), camera(0, age=0.03, psi=0.1), inertial(41))
    assert first.begins and not second.begins and len(first.packets) == 0
    (packet,) = second.packets
    found = packet[[PACKET.captured, PACKET.arrived, PACKET.quality, PACKET.value]]
    assert found.tolist() == [11.0, 41.0, 1.0, 0.1]


def test_a_stamp_tells_the_capture_even_where_its_row_is_late() -> None:
    """0 is of another clock: then the age counts from the row with which it goes."""
    assembler = StreamSynchroniser()
    ticks_of(assembler, inertial(100))
    late = camera(0, age=0.03, stamp=102_000), camera(1, age=0.05)
    tick = ticks_of(assembler, *late, inertial(105))[-1]
    assert tick.packets[:, [PACKET.captured, PACKET.arrived]].tolist() == [[55, 105], [72, 105]]


def test_packets_of_a_tick_have_the_records_order() -> None:
    batch = camera(0, age=0.01), camera(1, age=0.03), inertial(50)
    (tick,) = ticks_of(StreamSynchroniser(), *batch)
    assert tick.packets[:, PACKET.captured].tolist() == [20.0, 40.0]


def test_lost_rows_are_bridged_by_the_last_one() -> None:
    assembler = StreamSynchroniser()
    ticks_of(assembler, inertial(0, gyro=0.5))
    ticks = ticks_of(assembler, inertial(4, gyro=0.9))
    assert numbers(ticks) == [1, 2, 3, 4]
    assert [tick.row[FAST.gyro] for tick in ticks] == [0.5, 0.5, 0.5, 0.9]
    assert assembler.counts["held"] == 3 and assembler.counts["lost"] == 3


def test_silence_is_bridged_too_and_what_comes_late_is_dropped() -> None:
    assembler = StreamSynchroniser(patience=3)
    ticks_of(assembler, inertial(0))
    assert [numbers(ticks_of(assembler)) for _ in range(5)] == [[], [], [], [1, 2, 3, 4], [5]]
    assert numbers(ticks_of(assembler, inertial(1), inertial(5), inertial(6))) == [6]
    assert assembler.counts["late"] == 2 and assembler.counts["held"] == 5


def test_whoever_waits_for_ever_holds_nothing() -> None:
    assembler = StreamSynchroniser(None)
    ticks_of(assembler, inertial(0))
    assert not any(ticks_of(assembler) for _ in range(1000))


def test_doubled_and_reordered_ones_change_nothing() -> None:
    draw = random.Random(2)
    sound = [inertial(i, gyro=0.01 * i) for i in range(200)]
    noisy = StreamSynchroniser()
    with_noise: list[Tick] = []
    for i, arrival in enumerate(sound):
        batch = [arrival, arrival, *draw.sample(sound[: i + 1], min(3, i))]
        with_noise += ticks_of(noisy, *batch)
    plain = ticks_of(StreamSynchroniser(), *sound)
    assert numbers(with_noise) == numbers(plain)
    assert all(np.array_equal(a.row, b.row) for a, b in zip(plain, with_noise, strict=True))
    assert (
        noisy.counts[RejectReason.DUPLICATE] >= 200 and noisy.counts[RejectReason.REORDERED] > 200
    )


def test_sequence_numbers_wrap_around() -> None:
    assembler = StreamSynchroniser()
    for number in range(4):
        assert numbers(ticks_of(assembler, inertial(number, 2**32 - 2 + number))) == [number]
    assert not any(assembler.counts.values())


@pytest.mark.parametrize("to", [-1_000_000, 5_000_000], ids=["back", "ahead"])
def test_a_clock_that_jumps_begins_anew_and_is_counted(to: int) -> None:
    """Behind, after rows enough to tell it from stragglers."""
    assembler = StreamSynchroniser(None)
    start = 10_000_000
    ticks = ticks_of(assembler, *(inertial(start + i, i) for i in range(5)))
    ticks += ticks_of(assembler, *(inertial(start + to + i, i) for i in range(5, 300)))
    jump = next(tick for tick in ticks[1:] if tick.begins)
    late = MAX_BEHIND if to < 0 else 0
    assert jump.number == start + to + 5 + late and ticks[-1].number == start + to + 299
    assert assembler.counts["begun anew"] == 1 and assembler.counts["late"] == late


def test_a_sender_that_began_anew_is_heard_again() -> None:
    assembler = StreamSynchroniser(None)
    ticks_of(assembler, *(inertial(i, 5_000 + i) for i in range(3)))
    ticks = ticks_of(assembler, *(inertial(i, i) for i in range(200)))
    assert ticks and ticks[0].begins and ticks[-1].number == 199
    assert assembler.counts["restarted"] == 1


def test_the_longest_gap_that_is_bridged() -> None:
    for missing, begins in ((MAX_HELD, False), (MAX_HELD + 1, True)):
        assembler = StreamSynchroniser(None)
        ticks_of(assembler, inertial(0))
        last = ticks_of(assembler, inertial(1 + missing))[-1]
        assert last.begins == begins and last.number == 1 + missing


def test_what_is_of_no_use_here_is_counted_and_packets_do_not_pile_up() -> None:
    assembler = StreamSynchroniser()
    ticks_of(assembler, Arrival(0, encode(DatagramKind.CONTROL, 0, 0, [1.0, 0.0])))
    ticks_of(assembler, *(camera(i) for i in range(100)))
    (tick,) = ticks_of(assembler, inertial(0))
    assert assembler.counts[RejectReason.KIND] == 1 and assembler.counts["dropped"] == 36
    assert len(tick.packets) == 64 and assembler.accepted == [inertial(0).data]
