"""A slow sensor's kind, clock and link: what it sends, and when it captures and it arrives."""

from dataclasses import dataclass
from typing import NamedTuple

from ..numerics.functions import NEVER, TICK, count_ticks, draw_uniforms
from ..numerics.jit import jit
from ..numerics.primitives import Scalar, any_lane, floor, select, to_int
from ..validation import is_finite, short_repr

MAX_IN_FLIGHT = 8  # packets of one sensor under way at once, duplicates included


@dataclass(frozen=True)
class SlowSensor:
    """A slow sensor's clock and link, as estimators know it.

    A sample is captured every `period` from `phase` on. Frame i arrives `delays[i % len(delays)]`
    plus a random fraction of `jitter` later, unless it is lost or captured within an outage.

    Attributes:
        period: Time from sample to sample (s).
        delays: One to four delays that repeat (s).
        phase: Time of the first sample (s); None: drawn at each reset (the running env's
            `slow_sensors` have the drawn one).
        jitter: Largest random addition to a delay (s).
        loss: Probability that a packet is lost.
        duplicate: Probability that it arrives a second time.
    """

    period: float
    delays: tuple[float, ...] = (0.0,)
    phase: float | None = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    duplicate: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.delays, list | tuple):
            raise TypeError(f"a slow sensor's delays are a list, got {short_repr(self.delays)}")
        if not (is_finite(self.period) and self.period >= TICK):
            got = short_repr(self.period)
            raise ValueError(f"a slow sensor's period must be at least one tick, got {got}")
        if not 1 <= len(self.delays) <= 4:
            raise ValueError(f"expected one to four delays, got {short_repr(self.delays)}")
        times = (*self.delays, self.jitter, 0.0 if self.phase is None else self.phase)
        if not all(is_finite(time) and time >= 0.0 for time in times):
            rule = "a slow sensor's delays, jitter and phase must be finite and not negative"
            raise ValueError(f"{rule}, got {short_repr(times)}")
        object.__setattr__(self, "delays", tuple(float(d) for d in self.delays))
        for name in ("loss", "duplicate"):
            value = getattr(self, name)
            if not (is_finite(value) and 0.0 <= value <= 1.0):
                raise ValueError(f"{name} is a probability, got {short_repr(value)}")

    @property
    def longest_delay(self) -> float:
        """The longest delay, jitter included (s)."""
        return max(self.delays) + self.jitter


class Link(NamedTuple):
    """A slow sensor's clock and link in ticks; period 0: the sensor is absent."""

    period: Scalar
    phase: Scalar  # -1: drawn at reset
    n_delays: Scalar  # how many of the four delays repeat
    delay_0: Scalar
    delay_1: Scalar
    delay_2: Scalar
    delay_3: Scalar
    jitter: Scalar
    loss: Scalar
    duplicate: Scalar
    outage_start: Scalar
    outage_end: Scalar
    stamp: Scalar  # ticks by which a packet claims to be captured later; drawn

    @property
    def max_in_flight(self) -> int:
        """The most packets of a present sensor under way at once, duplicates included."""
        delay = max(self.delay_0, self.delay_1, self.delay_2, self.delay_3)
        longest = max(delay + self.jitter, self.stamp)  # nothing arrives before its stamp
        n_packets = int(longest // self.period) + 1
        return 2 * (n_packets + 1) if self.duplicate > 0.0 else n_packets


def make_link(
    sensor: SlowSensor | None, outage: tuple[float, float] | None = None, max_stamp: float = 0.0
) -> Link:
    """Convert a slow sensor to ticks, its stamp 0; ValueError for more packets than there is room.

    Args:
        sensor: Clock and link; None: an absent sensor.
        outage: (from, to) without packets (s).
        max_stamp: How much later than a capture its stamp is, at most (s).
    """
    if sensor is None:
        return Link._make([0.0] * len(Link._fields))
    delays = list(map(count_ticks, sensor.delays))
    phase = -1.0 if sensor.phase is None else count_ticks(sensor.phase)
    link = Link._make(
        [count_ticks(sensor.period), phase, float(len(delays)), *delays, *[0.0] * (4 - len(delays)),
         count_ticks(sensor.jitter), sensor.loss, sensor.duplicate,
         *map(count_ticks, outage or (0.0, 0.0)), count_ticks(max(max_stamp, 0.0))]
    )  # fmt: skip
    if link.max_in_flight > MAX_IN_FLIGHT:
        raise ValueError(
            f"a period of {sensor.period} s with delays up to {sensor.longest_delay:g} s and "
            f"stamps up to {max(max_stamp, 0.0):g} s later puts {link.max_in_flight} packets under "
            f"way at once; there is room for {MAX_IN_FLIGHT}"
        )
    return link._replace(stamp=0.0)


@jit
def compute_arrivals(
    link: Link, frame: Scalar, tick: Scalar, key_low: int, key_high: int, block: int
) -> tuple[Scalar, Scalar]:
    """Compute the ticks at which a frame and its duplicate arrive; NEVER where one does not.

    Args:
        link: `Link` of the sensor.
        frame: Number of the frame, from 0.
        tick: Tick of its capture.
        key_low: Lower 32 bits of the episode's key.
        key_high: Upper 32 bits of the episode's key.
        block: The sensor's channel of random numbers for its link.
    """
    jitter_share, loss_share, duplicate_share, second_share = 0.0, 0.0, 0.0, 0.0
    if any_lane((link.jitter > 0.0) | (link.loss > 0.0) | (link.duplicate > 0.0)):
        jitter_share, loss_share, duplicate_share, second_share = draw_uniforms(
            key_low, key_high, to_int(tick), block
        )
    i = frame - link.n_delays * floor(frame / link.n_delays)
    delay = select(i == 1.0, link.delay_1, link.delay_0)
    delay = select(i == 3.0, link.delay_3, select(i == 2.0, link.delay_2, delay))
    first = tick + delay + floor(jitter_share * (link.jitter + 1.0))
    is_outage = (tick >= link.outage_start) & (tick < link.outage_end)
    is_lost = is_outage | (loss_share < link.loss)
    second = first + 1.0 + floor(second_share * link.period)
    first = select(is_lost, NEVER, first)
    return first, select(is_lost | (duplicate_share >= link.duplicate), NEVER, second)


class PacketValue(NamedTuple):
    """One value of a slow sensor's packet."""

    name: str
    unit: str
    bound: float  # the observation clips at +- this


class Blocks(NamedTuple):
    """A slow sensor's channels: blocks of four random numbers a tick."""

    noise: int  # normal numbers
    link: int  # uniform ones: delay, loss, duplication, one unused
    drift: int  # normal numbers: the drift's innovation, its start at reset, two unused


class SlowKind(NamedTuple):
    """A row of the table of slow sensors, `slow.SLOW`."""

    name: str
    values: tuple[PacketValue, ...]
    blocks: Blocks | None = None  # None: of the sensor's place in the table
    needs_quality: bool = False  # at quality 0 the observation holds the sample before
