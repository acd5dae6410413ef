"""What is decoded is what was encoded, and nothing that comes makes the decoder raise."""

import math
import random
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sideslip.agents.live.messages import (
    FIELDS,
    HEADER,
    LIMIT,
    MAX_BYTES,
    MAX_STAMP,
    SENSORS,
    VERSION,
    DatagramKind,
    Message,
    RejectReason,
    decode,
    encode,
)
from sideslip.envs.record import FAST
from sideslip.envs.sensors.slow import SLOW
from tests.agents.live.both_ends import camera, inertial

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "live.md"
NUMBER = st.floats(-LIMIT, LIMIT)
SOUND = inertial(7).data


@given(
    st.sampled_from(
        [
            DatagramKind.INERTIAL,
            DatagramKind.CONTROL,
            DatagramKind.END,
            DatagramKind.STATUS,
            *SENSORS,
        ]
    ),
    st.integers(0, 2**32 - 1),
    st.integers(0, MAX_STAMP),
    st.data(),
)
def test_a_message_comes_back(
    kind: DatagramKind, sequence: int, stamp: int, data: st.DataObject
) -> None:
    width = len(FIELDS[kind])
    values = data.draw(st.lists(NUMBER, min_size=width, max_size=width))
    if kind in SENSORS:
        values[-2] = data.draw(st.floats(0.0, 10.0))
    assert decode(encode(kind, sequence, stamp, values)) == (kind, sequence, stamp, (*values,), ())


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


def test_a_hundred_thousand_random_ones_are_only_counted() -> None:
    """Half of them noise, half sound ones with a few bytes changed."""
    draw = random.Random(1)
    found = 0
    for i in range(100_000):
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
    assert 0 < found < 50_000


def test_the_format_is_the_documented_one() -> None:
    """Whoever changes a field changes VERSION and the page."""
    text = DOCUMENT.read_text()
    assert f"version {VERSION}" in text
    for kind, fields in FIELDS.items():
        row = re.search(
            rf"^\| {kind:d} \| {DatagramKind(kind).name.lower()} \| ([^|]*)\|", text, re.M
        )
        assert row and [each.strip(" `") for each in row[1].split(",")] == list(fields or ("-",))
    assert FIELDS[DatagramKind.INERTIAL][:-1] == FAST._fields
    for kind, place in SENSORS.items():
        assert FIELDS[kind][:-2] == tuple(value.name for value in SLOW[place].values)
