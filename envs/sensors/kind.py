"""A kind of slow sensor: its name, the values of its packets, its random numbers."""

from typing import NamedTuple


class PacketValue(NamedTuple):
    """One value of a slow sensor's packet."""

    name: str
    unit: str
    bound: float  # the observation clips at +- this


class Blocks(NamedTuple):
    """A slow sensor's channels in `backend.random`: blocks of four random numbers a tick."""

    noise: int  # normal numbers
    link: int  # uniform ones: delay, loss, duplication, one unused
    drift: int  # normal numbers: the drift's innovation, its start at reset, two unused


class SlowKind(NamedTuple):
    """A row of the table of slow sensors, `slow.SLOW`."""

    name: str
    values: tuple[PacketValue, ...]
    blocks: Blocks | None = None  # None: of the sensor's place in the table
    needs_quality: bool = (
        False  # at quality 0 it saw nothing: the observation holds the sample before
    )
