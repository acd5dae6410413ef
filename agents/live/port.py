"""UDP ports, and waiting for a point in time with what arrives meanwhile."""

import errno
import select
import socket
import time
from collections.abc import Sequence
from typing import Any

from .assemble import Arrival
from .datagrams import MAX_BYTES, DatagramKind, encode

LOOPBACK, PORT = "127.0.0.1", 47001
BUFFER = 1 << 22  # bytes of the kernel's, as far as it grants them
MAX_BATCH = 512  # datagrams of a batch: a flood of them does not stop the loop
SPIN = 150_000  # ns before a point in time, which sleeping alone would miss

clock = time.monotonic_ns
"""Time of the monotonic clock, which is never set (ns)."""


def parse_address(text: str, host: str = LOOPBACK) -> tuple[str, int]:
    """Parse HOST:PORT or PORT to an IPv4 address.

    Args:
        text: Text of the address.
        host: Host of a text without one.

    Returns:
        Host as an IPv4 address, and port.

    Raises:
        ValueError: The text is no address, or the host is unknown.
    """
    host_text, _, number = text.rpartition(":")
    if not (number.isascii() and number.isdigit() and 0 <= int(number) < 65536):
        raise ValueError(f"an address is HOST:PORT or PORT, got {text!r}")
    try:
        return socket.gethostbyname(host_text or host), int(number)
    except OSError as error:
        raise ValueError(f"{text!r} is no address of IPv4: {error}") from None


def wait_until(deadline: int) -> None:
    """Wait until a point in time.

    Args:
        deadline: Time of `clock` (ns).
    """
    if (left := deadline - clock() - SPIN) > 0:
        time.sleep(left * 1e-9)
    while clock() < deadline:
        pass


class Port:
    """A UDP port that listens on one of this machine's addresses, and numbers its datagrams.

    Args:
        host: Host to bind.
        port: Number to bind, 0 for any.

    Attributes:
        address: Bound host and port.
        unsent: Datagrams that the network did not take.

    Raises:
        OSError: The port is in use, or the host is unknown.
    """

    def __init__(self, host: str = LOOPBACK, port: int = 0) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
        self._socket.setblocking(False)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            reason = (
                "is in use" if error.errno == errno.EADDRINUSE else f"is none: {error.strerror}"
            )
            raise OSError(f"UDP port {port} of {host} {reason}") from None
        self.address: tuple[str, int] = self._socket.getsockname()
        self.unsent = 0
        self._sent: dict[int, int] = {}

    def send(
        self, to: Any, kind: DatagramKind, stamp: int, values: Sequence[float] = (), names: Any = ()
    ) -> None:
        """Send a message.

        Args:
            to: Address of the receiver.
            kind: Kind of the datagram.
            stamp: Time stamp (us).
            values: Values of `FIELDS`, in SI units.
            names: Names of states, for estimates.
        """
        number = self._sent[kind] = self._sent.get(kind, -1) + 1
        try:
            self._socket.sendto(encode(kind, number, stamp, values, names), to)
        except OSError:
            self.unsent += 1

    def receive_available(self, batch: list[Arrival]) -> list[Arrival]:
        """Append the datagrams that have arrived to a batch, up to `MAX_BATCH`.

        Args:
            batch: Datagrams so far, extended.

        Returns:
            The same batch.
        """
        while len(batch) < MAX_BATCH:
            try:
                data, sender = self._socket.recvfrom(MAX_BYTES + 1)
            except BlockingIOError:
                break
            except OSError:  # a message of the network about an earlier datagram
                continue
            batch.append(Arrival(clock(), data, sender))
        return batch

    def wait(self, seconds: float) -> list[Arrival]:
        """Wait for the first datagrams, and return none after a timeout.

        Args:
            seconds: Timeout (s).

        Returns:
            Datagrams in the order of their arrival.
        """
        select.select([self._socket], [], [], max(seconds, 0.0))
        return self.receive_available([])

    def receive_until(self, deadline: int) -> list[Arrival]:
        """Receive datagrams until a point in time, each with its time of arrival.

        Args:
            deadline: Time of `clock` (ns).

        Returns:
            Datagrams in the order of their arrival.
        """
        batch: list[Arrival] = []
        while (left := deadline - clock() - SPIN) > 0:
            if len(batch) >= MAX_BATCH:
                time.sleep(left * 1e-9)
                break
            if select.select([self._socket], [], [], left * 1e-9)[0]:
                self.receive_available(batch)
        while clock() < deadline:
            self.receive_available(batch)
        return self.receive_available(batch)

    def close(self) -> None:
        """Close the port."""
        self._socket.close()

    def __enter__(self) -> "Port":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
