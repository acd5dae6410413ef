"""Which sentences make an epoch, of one talker or several, and which lack their checksum."""

from itertools import chain, permutations

from sideslip.envs.recordings.nmea import DAY, Decoder

from .receiver import decoded, gga, rmc, sentence, zda

GSA = "GPGSA,A,3,05,08,15,,,,,,,,,,2.0,1.7,1.5"
NOON = 1704110400.0  # 2024-01-01


def test_a_date_comes_from_zda_too() -> None:
    vtg = sentence("GPVTG,90.0,T,,M,10.0,N,,K,A")
    epochs, _ = decoded(zda("115959") + gga("115959") + vtg + gga("120000") + vtg + zda("120000"))
    assert [epoch.t for epoch in epochs] == [NOON - 1.0, NOON]
    (epoch,), counts = decoded(zda("120000", "31", "02") + zda("", "", "", "") + gga())
    assert epoch.t == DAY / 2 and counts.emptied == {"ZDA day": 1}


def test_a_position_comes_from_gns_or_gll_where_there_is_no_gga() -> None:
    place = "4800.0000,N,01100.0000,E"
    for mode, fixed in (("AAN", True), ("NN", False), ("E", False), ("R", True)):
        gns = sentence(f"GNGNS,120000.00,{place},{mode},11,0.9,500.0,46.0,,")
        decoder = Decoder()
        (epoch,) = decoder.decode_chunk(rmc() + gns)
        assert (epoch.has_fix, epoch.hdop, epoch.satellites) == (fixed, 0.9, 11)
    vtg = sentence("GPVTG,90.0,T,,M,10.0,N,,K,A")
    for status, fixed in (("A", True), ("V", False)):
        times = (sentence(f"GPGLL,{place},12000{k}.00,{status},A") for k in range(3))
        epochs, _ = decoded(b"".join(gll + vtg + sentence(GSA) for gll in times))
        read = [(e.t % 60.0, e.has_fix, e.hdop) for e in epochs]
        assert read == [(k, fixed, 1.7) for k in range(3)]
    (epoch,), _ = decoded(rmc() + gga() + sentence("GPGLL,,,,,120000.00,V,N"))
    assert epoch.has_fix  # what a receiver says of its other sentences does not count


def test_several_talkers_make_one_epoch_of_one_time() -> None:
    def said(talker: str, time: str, order: tuple[str, ...]) -> list[bytes]:
        knots = {"GP": "1", "GA": "2", "GL": "3"}[talker] + time[-1]
        lines = {
            "GGA": gga(time), "RMC": rmc(time, spd=knots), "GSA": sentence(GSA),
            "VTG": sentence(f"GPVTG,90.0,T,,M,{knots},N,,K,A"),
        }  # fmt: skip
        return [sentence(talker + lines[kind][3:].decode().split("*")[0]) for kind in order]

    for order in permutations(("GGA", "VTG", "GSA")):
        for together in (True, False):
            data = b""
            for time in ("120000", "120001", "120002"):
                lines = [said(talker, time, order) for talker in ("GP", "GA", "GL")]
                lines = lines if together else list(map(list, zip(*lines, strict=True)))
                data += b"".join(chain(*lines))
            epochs, counts = decoded(data)
            assert [epoch.t % 60.0 for epoch in epochs] == [0.0, 1.0, 2.0], (order, together)
            assert counts.repeated == 6
            second = [round(epoch.speed * 3600.0 / 1852.0) % 10 for epoch in epochs]
            assert second == [0, 1, 2], (order, together)


def test_several_gsa_after_an_epoch_do_not_end_it() -> None:
    gll = sentence("GPGLL,4800.0000,N,01100.0000,E,120000.00,A,A")
    epochs, counts = decoded(rmc() + gga() + 3 * sentence("GN" + GSA[2:]) + gll + rmc("120001"))
    assert [epoch.t for epoch in epochs] == [NOON, NOON + 1.0] and counts.repeated == 0


def test_a_missing_checksum_is_told_from_a_line_cut_short() -> None:
    lines = [line.split(b"*")[0] for line in (rmc(), gga(), zda("120000"))]
    epochs, counts = decoded(
        b"\r\n".join(lines) + b"\r\n" + b"\r\n".join(x[:30] for x in lines[:2])
    )
    assert not epochs and (counts.unchecked, counts.truncated) == (3, 2)
