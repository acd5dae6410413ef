"""A receiver that sends sentences, and the recordings of real ones."""

from functools import reduce
from pathlib import Path

from sideslip.envs.recordings.nmea import Counts, Decoder, Epoch

_ROOT = Path(__file__).parents[3]
FOLDER = next(
    (path for path in (_ROOT / "shared", _ROOT.parent / "shared") if path.is_dir()), _ROOT
)
RECORDINGS = {
    name: FOLDER / "data" / "nmea" / name
    for name in ("munich-gps.nmea", "20100411_Geko_Regensburg.txt")
}
ABSENT = not all(path.exists() for path in RECORDINGS.values())
REASON = "the shared recordings are not here"


def sentence(content: str) -> bytes:
    """A line with its checksum, the exclusive or of its characters."""
    checksum = reduce(lambda a, b: a ^ b, content.encode(), 0)
    return f"${content}*{checksum:02X}\r\n".encode()


def rmc(time: str = "120000.00", day: str = "010124", **other: str) -> bytes:
    f = {"status": "A", "lat": "4800.0000,N", "lon": "01100.0000,E", "spd": "10.0", "cog": "90.0"}
    f |= other
    return sentence(
        f"GPRMC,{time},{f['status']},{f['lat']},{f['lon']},{f['spd']},{f['cog']},{day},,,A"
    )


def gga(time: str = "120000.00", hdop: str = "1.2", quality: str = "1", used: str = "08") -> bytes:
    return sentence(
        f"GPGGA,{time},4800.0000,N,01100.0000,E,{quality},{used},{hdop},500.0,M,46.0,M,,"
    )


def zda(time: str, day: str = "01", month: str = "01", year: str = "2024") -> bytes:
    return sentence(f"GPZDA,{time},{day},{month},{year},00,00")


def decoded(data: bytes, step: int | None = None) -> tuple[list[Epoch], Counts]:
    """The epochs of bytes fed in chunks of so many, or at once."""
    decoder = Decoder()
    epochs = []
    for i in range(0, len(data), step or max(len(data), 1)):
        epochs += decoder.decode_chunk(data[i : i + (step or len(data))])
    return epochs + decoder.finish(), decoder.counts
