"""What a receiver sends arrives as datagrams, from a file and over TCP, garbage or not."""

import math
import socket
from pathlib import Path
from threading import Thread

import pytest

pytest.importorskip("pynmeagps")

from sideslip.agents.live.loop import MAX_HDOP, Port, Relay
from sideslip.agents.live.messages import FIELDS, DatagramKind, Message, decode


def sentence(text: str) -> bytes:
    checksum = 0
    for letter in text.encode():
        checksum ^= letter
    return f"${text}*{checksum:02X}\r\n".encode()


def epoch(second: int, knots: float, course: float, valid: str = "A", hdop: str = "1.3") -> bytes:
    place = f"4807.{38 + second:03d},N,01131.000,E"
    quality = int(valid == "A")
    return sentence(
        f"GPRMC,1200{second:02d}.00,{valid},{place},{knots},{course},010126,,,A"
    ) + sentence(f"GPGGA,1200{second:02d}.00,{place},{quality},08,{hdop},500.0,M,46.9,M,,")


DRIVE = epoch(0, 20.0, 90.0) + epoch(1, 20.0, 0.0) + epoch(2, 20.0, 0.0, "V", "")


def received(port: Port, count: int) -> list[dict[str, float]]:
    """The values of the first datagrams of the GPS."""
    found: list[dict[str, float]] = []
    while len(found) < count and (arrivals := port.wait(5.0)):
        for each in arrivals:
            message = decode(each.data)
            assert isinstance(message, Message) and message.kind == DatagramKind.GPS
            found.append(dict(zip(FIELDS[DatagramKind.GPS], message.values, strict=True)))
    return found


def test_a_files_epochs_arrive_in_our_axes(tmp_path: Path) -> None:
    """East is 0, counter-clockwise is positive; without a fix the quality is 0."""
    path = tmp_path / "drive.nmea"
    path.write_bytes(DRIVE)
    with Port() as port, Port() as end:
        relay = Relay(str(path), port, end.address, latency=0.25, speed=1000.0)
        relay.run()
        first, second, lost = received(end, 3)
    assert relay.sent == 3 and relay.error == "" and relay.counts.epochs == 3
    assert first["course"] == 0.0 and math.isclose(second["course"], math.pi / 2)
    assert math.isclose(first["speed"], 20.0 * 1852 / 3600)
    assert (first["X"], first["Y"]) == (0.0, 0.0)
    assert math.isclose(second["Y"], math.radians(0.001 / 60) * 6_371_000, rel_tol=1e-3)
    assert (first["hdop"], first["satellites"], first["age"]) == (1.3, 8.0, 0.25)
    assert (first["quality"], lost["quality"], lost["hdop"]) == (1.0, 0.0, MAX_HDOP)
    assert math.isclose(lost["age"], 1.25)


def test_a_peer_that_sends_garbage_and_closes_is_a_counted_loss() -> None:
    """What was sound before it arrives; the error has the source and the reason."""
    server = socket.create_server(("127.0.0.1", 0))
    address = f"tcp:127.0.0.1:{server.getsockname()[1]}"

    def serve() -> None:
        peer, _ = server.accept()
        peer.sendall(b"\xff\x00$GARBAGE\r\n" + DRIVE[:-5] + bytes(range(256)))
        peer.close()
        server.close()

    thread = Thread(target=serve)
    thread.start()
    with Port() as port, Port() as end, pytest.MonkeyPatch.context() as patch:
        patch.setattr("time.sleep", lambda _: None)
        relay = Relay(address, port, end.address)
        relay.run()
        assert len(received(end, 2)) == 2
    thread.join()
    assert "not back after" in relay.error and address in relay.error
    assert relay.counts.garbage > 0


def test_it_stops_when_asked(tmp_path: Path) -> None:
    path = tmp_path / "drive.nmea"
    path.write_bytes(DRIVE)
    with Port() as port:
        relay = Relay(str(path), port, port.address)
        relay.run(lambda: relay.sent == 1)
    assert relay.sent == 1


def test_a_source_that_is_none_is_an_error() -> None:
    with Port() as port:
        for source, message in (("no such file", "no such file"), ("tcp:nowhere", "tcp:HOST:PORT")):
            with pytest.raises((OSError, ValueError), match=message):
                Relay(source, port, port.address)
