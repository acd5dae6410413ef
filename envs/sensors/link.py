"""A slow sensor's clock and link: when samples are captured, and when they arrive."""

from dataclasses import dataclass
from typing import Any, NamedTuple

from ..arguments import brief, is_finite
from ..backend.decorators import jit
from ..backend.primitives import anywhere, floor, select, whole
from ..backend.random import CHANNELS, uniforms
from ..ticks import NEVER, TICK, ticks

IN_FLIGHT = 8  # packets of one sensor under way at once, duplicates included


@dataclass(frozen=True)
class SlowSensor:
    """A slow sensor's clock and link, as estimators know it; times in seconds.

    A sample is captured every `period` from `phase` on (None: drawn at each reset; the running
    env's `slow_sensors` have the drawn one). Frame i arrives `delays[i % len(delays)]` plus a
    random share of `jitter` later, unless it is lost (`loss`, a probability) or captured within
    an outage. `duplicate` is the probability that it arrives a second time.
    """

    period: float
    delays: tuple[float, ...] = (0.0,)
    phase: float | None = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    duplicate: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.delays, list | tuple):
            raise TypeError(f"a slow sensor's delays are a list, got {brief(self.delays)}")
        if not (is_finite(self.period) and self.period >= TICK):
            got = brief(self.period)
            raise ValueError(f"a slow sensor's period must be at least one tick, got {got}")
        if not 1 <= len(self.delays) <= 4:
            raise ValueError(f"expected one to four delays, got {brief(self.delays)}")
        times = (*self.delays, self.jitter, 0.0 if self.phase is None else self.phase)
        if not all(is_finite(time) and time >= 0.0 for time in times):
            raise ValueError(
                "a slow sensor's delays, jitter and phase must be finite and not negative, "
                f"got {brief(times)}"
            )
        object.__setattr__(self, "delays", tuple(float(d) for d in self.delays))
        for name in ("loss", "duplicate"):
            value = getattr(self, name)
            if not (is_finite(value) and 0.0 <= value <= 1.0):
                raise ValueError(f"{name} is a probability, got {brief(value)}")

    @property
    def longest_delay(self) -> float:
        """The longest delay in seconds, jitter included."""
        return max(self.delays) + self.jitter


class Link(NamedTuple):
    """A slow sensor's clock and link in ticks; period 0: the sensor is absent."""

    period: Any
    phase: Any  # -1: drawn at reset
    patterns: Any  # how many of the four delays repeat
    delay_0: Any
    delay_1: Any
    delay_2: Any
    delay_3: Any
    jitter: Any
    loss: Any
    duplicate: Any
    outage_start: Any
    outage_end: Any


def link_of(sensor: SlowSensor | None, outage: tuple[float, float] | None = None) -> Link:
    """A Link from the public description; None: an absent sensor.

    Raises ValueError where more packets could be under way at once than the queue holds.
    """
    if sensor is None:
        return Link._make([0.0] * len(Link._fields))
    delays = [ticks(delay) for delay in sensor.delays]
    start, end = outage if outage is not None else (0.0, 0.0)
    d_0, d_1, d_2, d_3 = delays + [0.0] * (4 - len(delays))
    link = Link(
        ticks(sensor.period),
        -1.0 if sensor.phase is None else ticks(sensor.phase),
        float(len(delays)),
        d_0,
        d_1,
        d_2,
        d_3,
        ticks(sensor.jitter),
        sensor.loss,
        sensor.duplicate,
        ticks(start),
        ticks(end),
    )
    most = most_under_way(link)
    if most > IN_FLIGHT:
        raise ValueError(
            f"a period of {sensor.period} s with delays up to {sensor.longest_delay:g} s puts "
            f"{most} packets under way at once; there is room for {IN_FLIGHT}"
        )
    return link


def most_under_way(link: Link) -> int:
    """How many packets of a sensor that is there are under way at once, duplicates included."""
    longest = max(link.delay_0, link.delay_1, link.delay_2, link.delay_3) + link.jitter
    most = int(longest // link.period) + 1
    return 2 * (most + 1) if link.duplicate > 0.0 else most


@jit
def arrivals(link: Any, frame: Any, tick: Any, key_low: int, key_high: int, block: int) -> Any:
    """(first, second) arrival tick of the frame captured at `tick`; NEVER where there is none.

    Loss, outage, duplication, latency and jitter are this one function.
    """
    late, lost, twice, again = 0.0, 0.0, 0.0, 0.0  # what a link without chance makes nothing of
    if anywhere((link.jitter > 0.0) | (link.loss > 0.0) | (link.duplicate > 0.0)):
        late, lost, twice, again = uniforms(key_low, key_high, whole(tick), block)
    which = frame - link.patterns * floor(frame / link.patterns)
    delay = select(which == 1.0, link.delay_1, link.delay_0)
    delay = select(which == 2.0, link.delay_2, delay)
    delay = select(which == 3.0, link.delay_3, delay)
    first = tick + delay + floor(late * (link.jitter + 1.0))
    out = (tick >= link.outage_start) & (tick < link.outage_end)
    gone = out | (lost < link.loss)
    second = first + 1.0 + floor(again * link.period)
    first = select(gone, NEVER, first)
    return first, select(gone | (twice >= link.duplicate), NEVER, second)


@jit
def clock_phase(link: Any, key_low: int, key_high: int, which: int) -> Any:
    """The tick of the first capture: its phase, or drawn where that is -1."""
    u = uniforms(key_low, key_high, 0, CHANNELS.initial, 1 + which)
    return select(link.phase < 0.0, floor(u[0] * link.period), link.phase)
