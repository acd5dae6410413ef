"""Bytes of a receiver become epochs: fields, counts, and which sentences make one."""

import math
import re
from collections import Counter
from itertools import chain, pairwise, permutations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sideslip.envs.recordings.nmea import DAY, DECODED, LONGEST, Decoder, correct_dates

from .receiver import ABSENT, REASON, RECORDINGS, decoded, gga, rmc, sentence, zda

GSA = "GPGSA,A,3,05,08,15,,,,,,,,,,2.0,1.7,1.5"


def test_an_epoch_has_the_values_of_its_sentences_in_our_units() -> None:
    (epoch,), _ = decoded(rmc(spd="36.0", cog="120.0") + gga(hdop="0.9", used="11"))
    assert epoch.t == 1704110400.0  # 2024-01-01 12:00:00 UTC, by `date +%s`
    assert (epoch.latitude, epoch.longitude) == (48.0, 11.0)
    assert epoch.speed == pytest.approx(36.0 * 1852.0 / 3600.0, rel=1e-15)
    assert epoch.course == pytest.approx(math.radians(-30.0), abs=1e-15)
    assert (epoch.hdop, epoch.satellites, epoch.quality, epoch.age) == (0.9, 11, 1, 0.0)


@pytest.mark.parametrize(("north", "east"), [(0, 90), (90, 0), (180, -90), (270, 180), (359, 91)])
def test_a_course_turns_counter_clockwise_from_east(north: float, east: float) -> None:
    (epoch,), _ = decoded(rmc(cog=str(north)) + gga())
    assert math.cos(epoch.course - math.radians(east)) == pytest.approx(1.0, abs=1e-15)
    assert abs(epoch.course) <= math.pi


def test_south_and_west_are_negative() -> None:
    (epoch,), _ = decoded(rmc(lat="0030.0000,S", lon="17059.4000,W"))
    assert epoch.latitude == -0.5 and epoch.longitude == pytest.approx(-170.99)


@pytest.mark.parametrize("talker", ["GP", "GN", "GL", "BD"])
def test_motion_comes_from_vtg_where_there_is_no_rmc(talker: str) -> None:
    vtg = sentence(f"{talker}VTG,45.0,T,,M,,N,36.0,K,A")
    (epoch,), _ = decoded(gga() + vtg)
    assert epoch.course == pytest.approx(math.pi / 4)
    assert epoch.speed == pytest.approx(10.0)
    assert epoch.t == 43200.0  # no date was sent


def test_hdop_comes_from_gsa_where_gga_has_none() -> None:
    (epoch,), _ = decoded(rmc() + gga(hdop="") + sentence(GSA))
    assert epoch.hdop == 1.7
    (epoch,), _ = decoded(rmc() + sentence(GSA))
    assert (epoch.hdop, epoch.satellites) == (1.7, 3)


def test_satellites_in_view_are_those_of_all_systems() -> None:
    views = b"".join(
        sentence(text)
        for text in (
            "GPGSV,3,1,12,02,19,043,00,05,20,199,40,08,29,072,43,10,04,181,00",
            "GPGSV,3,2,12,15,74,283,52,17,16,132,38",
            "GLGSV,1,1,02,65,10,100,30,66,10,110,,A",  # with the signal's number
        )
    )
    (epoch,), counts = decoded(views + rmc() + gga())
    assert epoch.in_view == 14 and not counts.emptied


def test_an_epoch_comes_with_the_sentence_that_completes_it() -> None:
    decoder = Decoder()
    assert not decoder.decode_chunk(rmc())
    assert not decoder.decode_chunk(gga()[:-2])
    assert len(decoder.decode_chunk(gga()[-2:])) == 1
    assert not decoder.finish()


def test_an_incomplete_epoch_comes_when_the_next_begins() -> None:
    decoder = Decoder()
    assert not decoder.decode_chunk(rmc("120000"))
    (epoch,) = decoder.decode_chunk(rmc("120001"))
    assert epoch.t % 60.0 == 0.0 and math.isnan(epoch.hdop) and epoch.has_fix


def test_a_bad_field_is_emptied_and_counted_and_its_sentence_stays() -> None:
    data = rmc(cog="0NaN") + gga(hdop="0NaN") + sentence(GSA.replace("1.7", "inf"))
    (epoch,), counts = decoded(data)
    assert epoch.has_fix and epoch.speed > 5.0 and epoch.satellites == 8
    assert math.isnan(epoch.course) and math.isnan(epoch.hdop) and epoch.quality == 0
    assert counts.emptied == {"RMC cog": 1, "GGA HDOP": 1, "GSA HDOP": 1}


@pytest.mark.parametrize(
    "time", ["250000", "126000", "120061", "12000", "noon", "-10000", "120000x"]
)
def test_a_bad_time_is_emptied(time: str) -> None:
    (epoch,), counts = decoded(rmc(time) + gga(""))
    assert math.isnan(epoch.t) and epoch.has_fix
    assert counts.emptied == {"RMC time": 1} and counts.without_time == 1


def test_without_a_fix_nothing_but_satellites_is_known() -> None:
    data = rmc() + gga() + rmc("120003", status="V") + gga("120003", quality="0", used="02")
    first, second = decoded(data)[0]
    assert first.has_fix and not second.has_fix
    assert all(math.isnan(x) for x in (second.latitude, second.course, second.speed))
    assert (second.satellites, second.quality, second.age) == (2, 0, 3.0)
    set_back, unknown = decoded(data + rmc("110000", status="V") + rmc("", status="V"))[0][2:]
    assert set_back.age == 0.0 and math.isnan(unknown.age)


@pytest.mark.parametrize(("status", "quality"), [("V", "1"), ("A", "0"), ("A", "6")])
def test_a_fix_needs_the_consent_of_both_sentences(status: str, quality: str) -> None:
    (epoch,), counts = decoded(rmc(status=status) + gga(quality=quality))
    assert not epoch.has_fix and counts.without_fix == 1


@pytest.mark.parametrize(("mode", "has_fix"), [("A", True), ("E", False), ("N", False)])
def test_dead_reckoning_is_no_fix(mode: str, has_fix: bool) -> None:
    text = rmc().decode().partition("*")[0][1:-1] + mode
    (epoch,), _ = decoded(sentence(text) + gga())
    assert epoch.has_fix == has_fix


@pytest.mark.parametrize(("knots", "quality"), [("1.9", 0), ("2.0", 1), ("", 0)])
def test_below_one_metre_a_second_a_course_has_no_quality(knots: str, quality: int) -> None:
    (epoch,), _ = decoded(rmc(spd=knots) + gga())
    assert epoch.has_fix and epoch.quality == quality


def test_elapsed_time_goes_over_midnight_and_a_leap_second() -> None:
    times = [("235958", "311216"), ("235959", "311216"), ("235960", "311216")]
    times += [("000000", "010117"), ("000001", "010117")]
    epochs, counts = decoded(b"".join(rmc(*each) + gga(each[0]) for each in times))
    t = [epoch.t for epoch in epochs]
    assert t[0] == 1483228798.0 and [b - a for a, b in pairwise(t)] == [1.0] * 4
    assert counts.backward == 0
    epochs, counts = decoded(b"".join(gga(each) for each in ("235959", "000000", "000001")))
    assert [epoch.t for epoch in epochs] == [86399.0, 86400.0, 86401.0] and counts.backward == 0


def clocks(*times: str) -> list[tuple[float, float]]:
    """(t, t mended) of epochs "hhmmss" or "hhmmss ddmmyy", without a date or with one."""
    parts = [each.split() for each in times]
    data = b"".join((rmc(*each) if len(each) > 1 else b"") + gga(each[0]) for each in parts)
    epochs = decoded(data)[0]
    assert len(epochs) == len(times)
    return [(old.t, new.t) for old, new in zip(epochs, correct_dates(epochs), strict=True)]


def test_midnight_without_a_date_is_passed_forward_and_backward() -> None:
    t = [t for t, _ in clocks("235959", "000000", "235959", "000001")]
    assert t == [DAY - 1.0, DAY, DAY - 1.0, DAY + 1.0]
    (_, first), (_, back) = clocks("000000 010117", "235959")
    assert back - first == -1.0


NOON = 1704110400.0  # 2024-01-01, a Monday; 1024 weeks before it was 2004-05-17


@pytest.mark.parametrize(
    "times",
    [
        ("115958", "115959", "120000 010124"),  # the first date comes late
        ("115958 060180", "115959 060180", "120000 010124"),  # a cold start
        ("115958 170504", "115959 010124", "120000 010124"),  # a rollover that is mended
        ("115958 010124", "115959 010124", "120000 170504"),  # and one that begins
        ("115958 010124", "115959 311299", "120000 010124"),  # one wrong date
        ("115958", "115959 060180", "120000 010124"),
    ],
)
def test_a_log_has_one_date_where_the_time_of_day_goes_on(times: tuple[str, ...]) -> None:
    assert [t for _, t in clocks(*times)] == [NOON - 2.0, NOON - 1.0, NOON]


def test_a_date_that_is_late_or_early_at_midnight_is_mended() -> None:
    for days in (("311223", "311223", "010124"), ("010124", "010124", "010124")):
        times = zip(("235959", "000000", "000001"), days, strict=True)
        t = [t for _, t in clocks(*(f"{time} {day}" for time, day in times))]
        assert t == [NOON - DAY / 2 + k for k in (-1.0, 0.0, 1.0)]
    (_, early), (_, late) = clocks("080000", "100000 010124")  # the date comes after a tunnel
    assert (early, late) == (NOON - 4 * 3600.0, NOON - 2 * 3600.0)
    (_, first), (_, last) = clocks("235959", "000000 010124")
    assert (first, last) == (NOON - DAY / 2 - 1.0, NOON - DAY / 2)


def test_a_pause_of_days_and_a_log_of_another_era_remain() -> None:
    for times in (("120000 010124", "090000 030124"), ("120000 170504", "120001 170504")):
        assert all(old == new for old, new in clocks(*times))
    assert correct_dates([]) == []


def test_a_jump_forward_is_counted_like_one_backward_and_the_first_date_is_none() -> None:
    def steps(*times: str) -> tuple[int, int]:
        epochs, counts = decoded(b"".join(rmc(*each.split()) + gga(each[:6]) for each in times))
        assert len(epochs) == len(times)  # each is handed on
        return counts.forward, counts.backward

    assert steps("120000 060180", "120001 010124", "120002 010124") == (1, 0)
    assert steps("120000 010124", "120001 060180", "120002 060180") == (0, 1)
    assert steps("000000 010124", "100000 010124", "100001 010124") == (1, 0)
    counts = decoded(gga("115959") + rmc("120000") + gga("120000"))[1]
    assert (counts.forward, counts.backward) == (0, 0)


def test_what_is_no_sentence_of_ours_is_counted_and_skipped() -> None:
    data = b"# a title\r\n" + rmc()[:30] + b"\r\n" + rmc()[:20] + rmc() + b"$" + b"A" * LONGEST * 2
    data += b"\r\n" + rmc().replace(b"48", b"49") + sentence("PGRME,5.5,M,7.0,M,8.9,M") + gga()
    data += sentence("GPGLL,,,,,,V,N") + sentence("HCHDG,212.6,,,1.6,E") + bytes(range(128, 256))
    epochs, counts = decoded(data)
    assert len(epochs) == 1 and epochs[0].quality == 1
    kinds = {"RMC": 1, "GGA": 1, "GLL": 1, "of vendors": 1, "other": 1}
    assert counts.sentences == kinds
    assert (counts.truncated, counts.overlong, counts.bad_checksum) == (2, 1, 1)
    assert counts.garbage == len("# a title") + 2 * LONGEST + 128
    assert counts.received == len(data)


def test_a_sentence_sent_twice_is_counted() -> None:
    epochs, counts = decoded(rmc() + rmc() + gga() + rmc())
    assert len(epochs) == 1 and counts.repeated == 2


def pieces() -> st.SearchStrategy[bytes]:
    fields = st.text(st.characters(codec="ascii", exclude_characters="$*\r\n"), max_size=30)
    times = st.sampled_from(["120000", "120001.50", "235960", "000000", "", "0NaN"])
    talkers = ["GPRMC", "GNGGA", "GPGSA", "GLGSV", "GPVTG", "GNGNS", "GAGLL", "GPZDA", "PGRME"]
    kinds = st.sampled_from([*talkers, "G", ""])
    return st.one_of(
        st.binary(max_size=40),
        st.sampled_from([b"$", b"\r\n", b"\r", b"*", b"$" * 5, b"x" * (LONGEST + 3)]),
        st.builds(lambda kind, text: sentence(f"{kind},{text}"), kinds, fields),
        st.builds(rmc, times, st.sampled_from(["010124", "060180", "", "320124"])),
        st.builds(zda, times, st.sampled_from(["01", "31"]), st.sampled_from(["02", "12", "13"])),
        st.builds(gga, times, st.sampled_from(["1.0", "", "0NaN", "-1"])),
    )


@given(st.lists(pieces(), max_size=30).map(b"".join), st.data())
def test_any_bytes_in_any_chunks_give_what_they_give_at_once(
    data: bytes, draw: st.DataObject
) -> None:
    whole, counts = decoded(data)
    cuts = draw.draw(st.lists(st.integers(0, len(data)), max_size=20).map(sorted))
    decoder, epochs = Decoder(), []
    for low, high in zip([0, *cuts], [*cuts, len(data)], strict=True):
        epochs += decoder.decode_chunk(data[low:high])
        assert len(decoder._tail) <= LONGEST + 1  # what it holds
    epochs += decoder.finish()
    assert repr(epochs) == repr(whole)  # NaN included
    assert decoder.counts == counts


def test_memory_is_bounded_whatever_comes() -> None:
    decoder = Decoder()
    for i in range(3000):
        system = f"{chr(65 + i // 60)}{chr(65 + i % 60)}"
        decoder.decode_chunk(sentence(f"{system}GSV,1,1,{i % 100}") + sentence(f"XY{i:04d},1"))
        decoder.decode_chunk(sentence(f"GPRMC,{i}x,{i}y") + b"$" + b"y" * 500)
    assert len(decoder._view) <= 100 and len(decoder._tail) <= LONGEST + 1
    assert len(decoder.counts.sentences) <= 8 and len(decoder.counts.emptied) <= 20


def reference(data: bytes) -> Counter[str]:
    """Valid sentences by type, counted by a regular expression and a loop."""
    found: Counter[str] = Counter()
    for body, checksum in re.findall(rb"\$([^$*\r\n]*)\*([0-9A-F]{2})\r?\n", data):
        total = 0
        for byte in body:
            total ^= byte
        found[body[2:5].decode()] += total == int(checksum, 16)
    return found


@pytest.mark.skipif(ABSENT, reason=REASON)
@pytest.mark.parametrize("name", RECORDINGS)
def test_every_valid_sentence_of_the_recordings_is_decoded(name: str) -> None:
    data = RECORDINGS[name].read_bytes()
    epochs, counts = decoded(data, 997)
    expected = reference(data)
    assert {kind: counts.sentences[kind] for kind in DECODED} == {k: expected[k] for k in DECODED}
    assert counts.sentences.total() == expected.total() and not counts.bad_checksum
    assert counts.epochs == len(epochs) == expected["RMC"]
    munich = "munich" in name
    assert counts.without_fix == (20 if munich else 16)
    assert counts.backward == munich
    emptied = {"GGA HDOP": 1, "GSA HDOP": 1, "GSA PDOP": 1}
    assert counts.emptied == (emptied if munich else {})
    t = [epoch.t for epoch in epochs if epoch.has_fix]
    assert t[-1] - t[0] == (1864.0 if munich else 1576.0)
    assert all(48.0 < e.latitude < 50.0 and 11.0 < e.longitude < 13.0 for e in epochs if e.has_fix)


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
    epochs, counts = decoded(b"\r\n".join([*lines, lines[0][:30], lines[1][:30]]))
    assert not epochs and (counts.unchecked, counts.truncated) == (3, 2)
