"""What is decoded is what was encoded, and ticks follow each other whatever comes."""

import math
import random
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sideslip.agents.live.messages import (
    FIELDS,
    HEADER,
    LIMIT,
    MAX_BEHIND,
    MAX_BYTES,
    MAX_HELD,
    MAX_STAMP,
    SENSORS,
    VERSION,
    Arrival,
    DatagramKind,
    Message,
    RejectReason,
    StreamSynchroniser,
    Tick,
    decode,
)
from sideslip.envs.record import FAST, PACKET
from sideslip.envs.sensors.slow import SLOW
from tests.agents.live.both_ends import camera, encode, inertial

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "howto" / "live.md"
NUMBER, STAMP = st.floats(-LIMIT, LIMIT), st.integers(0, MAX_STAMP)
SOUND = inertial(7).data


@settings(max_examples=40)
@given(st.sampled_from(sorted(FIELDS)), st.integers(0, 2**32 - 1), STAMP, st.data())
def test_a_message_comes_back(kind: int, sequence: int, stamp: int, data: st.DataObject) -> None:
    width = len(FIELDS[kind])
    values = data.draw(st.lists(NUMBER, min_size=width, max_size=width))
    if kind in SENSORS:
        values[-2] = data.draw(st.floats(0.0, 10.0))
    assert decode(encode(kind, sequence, stamp, values)) == (kind, sequence, stamp, (*values,), ())


@settings(max_examples=40)
@given(st.lists(st.from_regex(r"[a-z_][a-z_0-9]{0,8}", fullmatch=True), min_size=1, max_size=20))
def test_estimates_come_back_with_their_names(names: list[str]) -> None:
    values = [float(i) for i in range(2 * len(names))]
    found = decode(encode(DatagramKind.ESTIMATE, 1, 2, values, names))
    assert isinstance(found, Message) and found.names == (*names,) and found.values == (*values,)


def changed(at: int, *new: int) -> bytes:
    return SOUND[:at] + bytes(new) + SOUND[at + len(new) :]


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", RejectReason.FOREIGN),
        (SOUND[: HEADER.size - 1], RejectReason.FOREIGN),
        (changed(0, 0x73), RejectReason.FOREIGN),
        (changed(4, VERSION + 1), RejectReason.VERSION),
        (changed(5, 0), RejectReason.KIND),
        (changed(5, 200), RejectReason.KIND),
        (SOUND[:-1], RejectReason.LENGTH),
        (SOUND + b"\0", RejectReason.LENGTH),
        (changed(6, 0, 1), RejectReason.LENGTH),
        (encode(DatagramKind.ESTIMATE, 0, 0, [1.0, 2.0, 3.0], ["beta"]), RejectReason.LENGTH),
        (encode(DatagramKind.ESTIMATE, 0, 0, [1.0, 2.0], ["a", "b"]), RejectReason.LENGTH),
        (SOUND + bytes(MAX_BYTES), RejectReason.OVERSIZED),
        (inertial(0, gyro=math.nan).data, RejectReason.NOT_FINITE),
        (inertial(0, gyro=math.inf).data, RejectReason.NOT_FINITE),
        (inertial(0, gyro=2 * LIMIT).data, RejectReason.RANGE),
        (inertial(-1, 0).data, RejectReason.RANGE),
        (
            encode(DatagramKind.INERTIAL, 0, 2**63 - 1, [0.0] * len(FIELDS[DatagramKind.INERTIAL])),
            RejectReason.RANGE,
        ),
        (camera(0, age=-0.01).data, RejectReason.RANGE),
        (camera(0, age=11.0).data, RejectReason.RANGE),
    ],
)
def test_every_fault_has_its_name(data: bytes, why: RejectReason) -> None:
    assert decode(data) is why


def test_twenty_thousand_random_ones_are_only_counted() -> None:
    """Half of them noise, half sound ones with a few bytes changed."""
    draw = random.Random(1)
    found = 0
    for i in range(20_000):
        if i % 2:
            data = bytearray(draw.choice((SOUND, camera(i).data)))
            for _ in range(draw.randrange(1, 5)):
                data[draw.randrange(len(data))] = draw.randrange(256)
        else:
            data = bytearray(draw.randbytes(draw.randrange(160)))
        message = decode(bytes(data))
        found += isinstance(message, Message)
        if isinstance(message, Message):
            assert all(abs(value) <= LIMIT for value in message.values)
    assert 0 < found < 10_000


def test_the_format_is_the_documented_one() -> None:
    """Whoever changes a field changes VERSION and the page."""
    text = DOCUMENT.read_text()
    assert f"version {VERSION}" in text
    for kind, fields in FIELDS.items():
        name = DatagramKind(kind).name.lower()
        row = re.search(rf"^\| {kind:d} \| {name} \| ([^|]*)\|", text, re.M)
        assert row and [each.strip(" `") for each in row[1].split(",")] == list(fields or ("-",))
    assert FIELDS[DatagramKind.INERTIAL][:-1] == FAST._fields
    for kind, place in SENSORS.items():
        assert FIELDS[kind][:-2] == tuple(value.name for value in SLOW[place].values)


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
    assert noisy.counts[RejectReason.DUPLICATE] >= 200
    assert noisy.counts[RejectReason.REORDERED] > 200


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


def test_a_camera_that_began_anew_is_heard_at_once() -> None:
    assembler = StreamSynchroniser(None)
    for tick, number in enumerate((20, 21, 0, 1), start=1):  # its numbers start again, time goes on
        ticks = ticks_of(assembler, camera(number, stamp=1000 * tick), inertial(tick))
        assert len(ticks[0].packets) == 1
    late, *_ = ticks_of(assembler, camera(0, stamp=3000), inertial(5))
    assert not len(late.packets) and assembler.counts["restarted"] == 1
    assert assembler.counts[RejectReason.REORDERED] == 1


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
