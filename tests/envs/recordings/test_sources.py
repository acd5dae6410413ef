"""A file, a serial port and a TCP peer give the same bytes; what is lost ends clearly."""

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from sideslip.envs.recordings.nmea import Decoder, Epoch
from sideslip.envs.recordings.sources import ByteSource, is_nmea, make_source, read_nmea

from .receiver import gga, rmc, sentence

SECONDS = [f"1200{i:02d}" for i in range(20)]
LOG = b"".join(rmc(time) + gga(time) for time in SECONDS)


def collected(source: ByteSource, count: int) -> list[Epoch]:
    """The first so many epochs, however long they take."""
    decoder, epochs = Decoder(), []
    for chunk in source:
        epochs += decoder.decode_chunk(chunk)
        if len(epochs) >= count:
            break
    return epochs


@contextmanager
def peer(serve: Callable[[socket.socket], None], times: int) -> Iterator[str]:
    """A TCP peer on loopback that serves so many connections and is then gone."""
    server = socket.create_server(("127.0.0.1", 0))

    def run() -> None:
        for _ in range(times):
            connection, _address = server.accept()
            with connection:
                serve(connection)
        server.close()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    yield f"tcp:127.0.0.1:{server.getsockname()[1]}"
    thread.join(10.0)
    server.close()


def test_a_file_ends(tmp_path: Path) -> None:
    path = tmp_path / "drive.nmea"
    path.write_bytes(LOG)
    assert b"".join(make_source(str(path))) == LOG
    epochs, counts = read_nmea(path)
    assert len(epochs) == counts.epochs == len(SECONDS)


def test_a_log_is_dated_by_its_last_date_and_how_many_epochs_were_is_counted(
    tmp_path: Path,
) -> None:
    path = tmp_path / "drive.nmea"
    path.write_bytes(gga("115958") + rmc("115959", "060180") + gga("115959") + LOG)
    epochs, counts = read_nmea(path)
    assert [epoch.t for epoch in epochs] == [1704110398.0 + k for k in range(22)]
    assert (counts.redated, counts.forward) == (2, 1)


def test_a_serial_port_that_vanishes_ends_clearly() -> None:
    ours, theirs = os.openpty()
    name = os.ttyname(theirs)
    source = replace(make_source(f"serial:{name}:9600"), tries=2, wait=0.01)
    chunks = iter(source)
    assert next(chunks) == b""  # open: what came before is flushed
    os.write(ours, LOG[:1000])
    got = b""
    while len(got) < 1000:
        got += next(chunks) or pytest.fail("bytes were lost")
    assert got == LOG[:1000]
    os.close(theirs)
    os.close(ours)
    with pytest.raises(ConnectionError, match=f"serial:{name}:9600: lost, and not back after 2"):
        list(chunks)
    assert source.losses >= 1


def test_a_quiet_port_hands_out_nothing_again_and_again() -> None:
    ours, theirs = os.openpty()
    chunks = iter(make_source(f"serial:{os.ttyname(theirs)}"))
    assert next(chunks) == b"" == next(chunks)
    os.write(ours, b"$GP")
    assert next(chunks)[:1] == b"$"
    os.close(ours)
    os.close(theirs)


def test_a_peer_that_closes_is_called_again_and_nothing_whole_is_lost() -> None:
    half = len(LOG) // 2  # amid a sentence
    parts = iter([LOG[:half], LOG[half:]])
    with peer(lambda connection: connection.sendall(next(parts)), 2) as text:
        source = replace(make_source(text), tries=2, wait=0.01)
        epochs = collected(source, len(SECONDS))
    assert len(epochs) == len(SECONDS) and source.losses == 1


def test_a_line_is_opened_again_so_many_times_and_no_more() -> None:
    opened = []

    def reset() -> Iterator[bytes]:
        opened.append(1)
        yield b""
        raise ConnectionResetError("reset")

    with pytest.raises(ConnectionError, match="quiet: lost, and not back after 3 tries: reset"):
        list(ByteSource("quiet", reset, tries=3, wait=0.0))
    assert len(opened) == 1 + 3


def test_garbage_of_a_peer_is_counted_and_what_follows_decoded() -> None:
    garbage = os.urandom(1 << 20)
    with peer(lambda connection: connection.sendall(garbage + b"\r\n" + LOG), 1) as text:
        epochs = collected(replace(make_source(text), wait=0.01), len(SECONDS))
    assert [epoch.t % 60.0 for epoch in epochs[-20:]] == [float(i) for i in range(20)]


def test_a_line_that_cannot_be_opened_is_an_error_at_once(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"/no/such/port"):
        list(make_source("serial:/no/such/port"))
    server = socket.create_server(("127.0.0.1", 0))
    port = server.getsockname()[1]
    server.close()
    with pytest.raises(ConnectionRefusedError):
        list(make_source(f"tcp:127.0.0.1:{port}"))
    with pytest.raises(FileNotFoundError, match=r"gone\.nmea: there is no such file"):
        make_source(str(tmp_path / "gone.nmea"))
    with pytest.raises(ValueError, match="found a folder"):
        make_source(str(tmp_path))


@pytest.mark.parametrize("text", ["tcp:", "tcp:host", "tcp::80", "tcp:host:0", "tcp:host:65536"])
def test_a_text_of_another_form_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="expected tcp:HOST:PORT"):
        make_source(text)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "the file is empty"),
        (bytes(range(256)) * 100, "no valid NMEA sentence in 25600 bytes"),
        (rmc().replace(b"48", b"49") * 3, "3 sentences with a bad checksum"),
        (
            gga().split(b"*")[0] + b"\r\n" + gga()[:30],
            "1 sentences cut short, 1 sentences without a checksum",
        ),
        (rmc(status="V") + gga(quality="0"), "none of 1 epochs has a fix; sentences: 1 GGA, 1 RMC"),
        (rmc("") + gga(""), "none of 1 epochs has both a fix and a time"),
        (sentence("GPGSV,1,1,00") * 3, "none of 0 epochs has a fix; sentences: 3 GSV"),
    ],
)
def test_what_is_no_log_is_refused_by_name(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "drive.nmea"
    path.write_bytes(data)
    with pytest.raises(ValueError, match=rf"drive\.nmea: .*{message}"):
        read_nmea(path)


def test_a_log_is_known_by_its_content(tmp_path: Path) -> None:
    for name, data in (("a.txt", LOG), ("b.log", b"# title\n" + LOG), ("c.csv", LOG)):
        (tmp_path / name).write_bytes(data)
        assert is_nmea(tmp_path / name)
    (tmp_path / "e.txt").write_bytes(gga().split(b"*")[0])
    assert is_nmea(tmp_path / "e.txt")
    (tmp_path / "d.txt").write_bytes(b"time_s,price_$\n1,2\n")
    assert not is_nmea(tmp_path / "d.txt")
    assert not is_nmea(tmp_path / "gone.csv")
    assert is_nmea(tmp_path / "gone.nmea")


@pytest.mark.parametrize("library", ["pynmeagps", "serial"])
def test_a_missing_library_is_named_with_its_extra(library: str, tmp_path: Path) -> None:
    (tmp_path / "a.nmea").write_bytes(LOG)
    code = f"""
import sys
sys.modules[{library!r}] = None
from sideslip.envs.recordings.sources import make_source, read_nmea
try:
    read_nmea("a.nmea")
    list(make_source("serial:/no/such/port"))
except ModuleNotFoundError as error:
    print(error)
"""
    command = [sys.executable, "-c", code]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    run = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert "pip install 'sideslip[wires]'" in run.stdout and "needs py" in run.stdout
