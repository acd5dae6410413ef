"""The loop ends with a reason, and what it measures is what happened."""

import gc
import time
from typing import Any

import numpy as np
import pytest

from sideslip.agents.live.loop import MAX_BATCH, PERIOD, Loop, Port, _Histogram, clock
from sideslip.agents.live.messages import (
    FIELDS,
    TICK_US,
    Arrival,
    DatagramKind,
    Message,
    StreamSynchroniser,
    decode,
)
from sideslip.benchmarks.cli.live import _parse_address
from tests.agents.live.both_ends import camera, inertial, onboard, watch_ticks

ROW = [0.0, 0.0, 0.0, 0.0, 7.0, 7.0] + [0.0] * (len(FIELDS[DatagramKind.INERTIAL]) - 6)


def test_no_inertial_data_is_an_error_with_the_address() -> None:
    with Port() as port:
        loop = Loop(onboard(), StreamSynchroniser(), port, patience=0.2)
        with pytest.raises(TimeoutError, match=rf"no inertial datagram .*{port.address[1]}"):
            loop.run()


def test_inertial_data_that_ends_ends_the_loop_after_a_while() -> None:
    """Meanwhile the last row is held, and every tick is counted."""
    with Port() as port, Port() as car:
        loop = Loop(onboard(), StreamSynchroniser(), port, patience=0.3)
        car.send(port.address, DatagramKind.INERTIAL, 0, ROW)
        loop.run()
        assert loop.ended == "no inertial data for 0.3 s"
        assert loop.statistics.ticks == loop.assembler.counts["held"] + 1 > 10


def test_it_stops_when_asked_and_when_the_time_is_over() -> None:
    with Port() as port:
        loop = Loop(onboard(), StreamSynchroniser(), port)
        loop.run(lambda: True)
        assert loop.ended == "stopped"
        loop.run(duration=0.05)
        assert loop.ended == "the time is over"
    assert gc.isenabled()  # the collector is as it was


def test_estimates_go_to_everybody_and_controls_back_to_the_car() -> None:
    with Port() as port, Port() as car, Port() as user, Port() as viewer:
        others = [user.address], viewer.address
        loop = Loop(onboard(), StreamSynchroniser(None), port, *others, step=True)
        for number in range(201):
            car.send(port.address, DatagramKind.INERTIAL, number * TICK_US, ROW)
        car.send(port.address, DatagramKind.END, 0)
        loop.run()
        sent, shown, controls = ([decode(each.data) for each in end.wait(1.0)]
                                 for end in (user, viewer, car))  # fmt: skip
    assert all(isinstance(each, Message) for each in (*sent, *shown, *controls))
    stamps = [each.stamp // TICK_US for each in controls if isinstance(each, Message)]
    assert stamps == list(range(0, 201, 10))
    kinds = [each.kind for each in shown if isinstance(each, Message)]
    assert kinds.count(DatagramKind.ESTIMATE) == 21 and kinds.count(DatagramKind.STATUS) == 3
    assert len(sent) == 201 and isinstance(sent[-1], Message)
    assert sent[-1].names == loop.onboard.names
    assert sent[-1].values == (*loop.onboard.x, *loop.onboard.std)


def test_controls_follow_a_sender_that_begins_anew() -> None:
    """From another address, as after a restart; a camera at a third one gets none."""
    with Port() as port, Port() as car, Port() as restarted, Port() as eye:
        loop = Loop(onboard(), StreamSynchroniser(None), port, step=True)
        for sender, first in ((car, 5_000), (restarted, 0)):
            loop._take([inertial(k, first + k)._replace(sender=sender.address) for k in range(11)])
            loop._take([camera(first)._replace(sender=eye.address)])
        loop._take([inertial(k)._replace(sender=restarted.address) for k in range(11, 31)])
        assert [len(end.wait(0.1)) for end in (car, restarted, eye)] == [2, 4, 0]


def test_a_busy_loop_counts_the_deadlines_it_missed_and_catches_none_up() -> None:
    with Port() as port, Port() as car:
        loop = Loop(onboard(), StreamSynchroniser(), port)
        watch_ticks(loop.onboard, lambda x: time.sleep(0.0205) if x.number == 1 else None)
        car.send(port.address, DatagramKind.INERTIAL, 0, ROW)
        assert loop._take(port.wait(1.0)) == 1
        car.send(port.address, DatagramKind.INERTIAL, TICK_US, ROW)
        deadline = clock() + PERIOD
        following = loop._run_tick(deadline)
        assert following > clock() - 5 * PERIOD
        assert loop.statistics.deadlines == 1 + loop.statistics.misses >= 21
        assert (following - deadline - PERIOD * (1 + loop.statistics.misses)) < PERIOD / 100
        assert loop.statistics.latency.largest > 20_000


def test_the_phase_follows_the_senders_clock() -> None:
    """A deadline is drawn towards LEAD behind the rows, a little each tick."""
    from sideslip.agents.live.loop import LEAD, MAX_PHASE_STEP, PHASE_GAIN

    class Fake(Port):
        def _receive_until(self, when: int) -> list[Arrival]:
            sound = super()._receive_until(when)
            return [each._replace(at=when - 900_000) for each in sound]

    with Fake() as port, Port() as car:
        loop = Loop(onboard(), StreamSynchroniser(), port)
        car.send(port.address, DatagramKind.INERTIAL, 0, ROW)
        start = clock() + 50_000_000
        following = loop._run_tick(start)
        drawn = following - start - PERIOD * (1 + loop.statistics.misses)
        assert drawn == max(-MAX_PHASE_STEP, round(PHASE_GAIN * (LEAD - 900_000))) < 0


def test_quantiles_are_those_of_the_times() -> None:
    times = np.random.default_rng(0).gamma(2.0, 50.0, 10_001)
    histogram = _Histogram()
    assert histogram.summarise() == {}
    for each in times:
        histogram.add(float(each))
    for share in (0.5, 0.9, 0.999):
        exact = np.quantile(times, share, method="inverted_cdf")
        assert exact <= histogram.quantile(share) <= exact + 1.0
    histogram.add(1e9)
    assert histogram.largest == histogram.quantile(1.0) == 1e9
    (once := _Histogram()).add(5.3)
    assert once.summarise() == {"median": 5.3, "p999": 5.3, "max": 5.3}


def test_a_port_in_use_is_an_error_and_a_flood_ends() -> None:
    with Port() as port, Port() as other:
        with pytest.raises(OSError, match=f"UDP port {port.address[1]} of 127.0.0.1 is in use"):
            Port(port=port.address[1])
        with pytest.raises(OSError, match=r"of 192.0.2.1 is none"):
            Port("192.0.2.1", 0)
        with pytest.raises(OSError, match=r"UDP port 70000 of 127.0.0.1 is none: .*0-65535"):
            Port(port=70000)
        assert port.address[0] == "127.0.0.1"
        for _ in range(MAX_BATCH + 100):
            other.send(port.address, DatagramKind.END, 0)
        assert len(port.wait(1.0)) <= MAX_BATCH


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("10.0.0.7:1", ("10.0.0.7", 1)),
        ("8", ("127.0.0.1", 8)),
        (":8", ("127.0.0.1", 8)),
        ("localhost:9", ("127.0.0.1", 9)),
    ],
)
def test_addresses(text: str, found: Any) -> None:
    assert _parse_address(text) == found


@pytest.mark.parametrize("text", ["", "h", "h:", "h:x", "h:70000", "h:-1", "[::1]:2"])
def test_what_is_no_address(text: str) -> None:
    with pytest.raises(ValueError, match="address"):
        _parse_address(text)
