"""Noise that follows HDOP is found to pay where it does, and to cost where it does not."""

import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sideslip.benchmarks.recorded import receiver
from sideslip.benchmarks.report.study import LETTERS, LINES
from sideslip.envs.recordings.dialect import to_degrees
from sideslip.envs.recordings.nmea import Epoch
from sideslip.estimators.filters import FILTERS
from tests.benchmarks.conftest import Run
from tests.envs.recordings.receiver import ABSENT, REASON, RECORDINGS, sentence

ORIGIN = (48.0, 11.0)
Q, NOISE = 2.0, 1.5


def drive(weight: float, count: int = 500, seed: int = 0) -> list[Epoch]:
    """Fixes of a car with white acceleration; the noise follows HDOP by so much."""
    rng = np.random.default_rng(seed)
    hdop = np.round(np.exp(rng.normal(0.9, 0.7, count)).clip(0.8, 15.0), 1)
    force = np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]) * Q
    x = np.array([[0.0, 0.0], [8.0, 8.0]])
    knots, factors = zip(*FILTERS["double-layer"].hdop_table, strict=True)
    sizes, epochs = NOISE * (1.0 + weight * (np.interp(hdop, knots, factors) - 1.0)), []
    for k, size in enumerate(sizes):
        push = np.linalg.cholesky(force) @ rng.normal(size=(2, 2))
        x = np.array([[1.0, 1.0], [0.0, 1.0]]) @ x + push
        place = x[0] + size * rng.normal(size=2)
        speed = math.hypot(*x[1])
        course = math.atan2(x[1, 1], x[1, 0]) + 0.05 * size / speed * rng.normal()
        (north,), (east,) = to_degrees(place[:1], place[1:], ORIGIN)
        epochs.append(Epoch(1e9 + k, north, east, course, speed, hdop[k], 8, 10, 1, 0.0))
    return epochs


def log_of(epochs: list[Epoch], path: Path) -> Path:
    """The same drive as a receiver would write it."""
    lines = b""
    for e in epochs:
        clock = math.floor(e.t) % 86400
        time = f"{clock // 3600:02d}{clock // 60 % 60:02d}{clock % 60:02d}"
        north, east = (
            f"{math.floor(x):0{n}d}{x % 1 * 60:09.6f}"
            for x, n in ((e.latitude, 2), (e.longitude, 3))
        )
        course, knots = (90.0 - math.degrees(e.course)) % 360.0, e.speed * 3600.0 / 1852.0
        place = f"{north},N,{east},E"
        lines += sentence(f"GPRMC,{time},A,{place},{knots:.3f},{course:.2f},090901,,,A")
        lines += sentence(f"GPGGA,{time},{place},1,08,{e.hdop:.1f},500.0,M,46.0,M,,")
    path.write_bytes(lines)
    return path


def position_of(track: receiver._Track) -> receiver._Signal:
    n = len(track.t)
    where = np.asarray(track.east + 1j * track.north, np.complex128)
    return receiver._Signal("position", 2, where, np.ones(n), 20.0, track, np.ones(n, bool))


def test_predictions_are_gaussian_conditioning() -> None:
    """On all fixes between the first, where the filter starts, and the one that is predicted."""
    n, track = 12, receiver._make_track(drive(1.0, 12))
    R = (NOISE * track.hdop) ** 2
    signal = position_of(track)
    where = signal.z
    error, variance = receiver._predict_fixes(signal, R, Q)
    assert np.isnan(error[:4]).all() and np.isfinite(error[4:]).all()
    step = np.array([[1.0, 1.0], [0.0, 1.0]])
    state, full = np.diag([R[0], 400.0]), np.zeros((2 * n, 2 * n))
    full[:2, :2] = state
    for k in range(2, 2 * n, 2):
        full[k : k + 2, :k] = step @ full[k - 2 : k, :k]
        full[:k, k : k + 2] = full[k : k + 2, :k].T
        state = step @ state @ step.T + Q * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
        full[k : k + 2, k : k + 2] = state
    z = (full[::2, ::2] + np.diag(R))[1:, 1:]
    values = where[1:] - where[0]
    for k in range(4, n):
        weight = np.linalg.solve(z[: k - 1, : k - 1], z[: k - 1, k - 1])
        assert variance[k] == pytest.approx(z[k - 1, k - 1] - weight @ z[: k - 1, k - 1], rel=1e-9)
        assert error[k] == pytest.approx(abs(values[k - 1] - weight @ values[: k - 1]), rel=1e-6)


@cache
def compared(weight: float) -> tuple[receiver._Signal, dict[str, receiver._NoiseLawResult]]:
    """The position of a drive, and the results of all laws."""
    (position, _) = receiver._make_signals(receiver._make_track(drive(weight)))
    return position, receiver._compare(position)


def test_likelihood_finds_the_noise_and_who_follows_hdop_rightly_wins() -> None:
    _, found = compared(1.0)
    table = found["table"]
    assert table.r == pytest.approx(NOISE, rel=0.15)
    assert table.q == pytest.approx(Q, rel=0.35)
    assert table.square.mean() == pytest.approx(1.0, abs=0.15)
    assert receiver._compute_gain(table, found["constant"]).low > 0.0
    assert np.median(table.error) < np.median(found["constant"].error)


def test_where_the_noise_is_constant_tuning_by_hdop_costs() -> None:
    _, found = compared(0.0)
    assert found["constant"].r == pytest.approx(NOISE, rel=0.15)
    assert receiver._compute_gain(found["table"], found["constant"]).high < 0.0


def test_a_track_leaves_out_what_steps_back_and_starts_anew_where_the_clock_is_set() -> None:
    epochs = drive(0.0, 40)
    blind = epochs[5]._replace(hdop=math.nan)
    lost = epochs[6]._replace(latitude=math.nan)
    set_back = [each._replace(t=each.t - 500.0) for each in epochs[20:]]
    sent = [*epochs[:5], blind, lost, *epochs[7:10], epochs[9], *epochs[10:20], *set_back]
    track = receiver._make_track(sent)
    assert len(track.t) == 38 and track.t[18] < track.t[17] - 400.0
    assert track.east[0] == track.north[0] == 0.0
    scored = np.isfinite(receiver._predict_fixes(position_of(track), np.ones(38), Q)[0])
    assert not scored[[0, 1, 2, 3, 18, 19, 20, 21]].any() and scored[22:].all()


def test_a_log_is_answered_drawn_and_laid_on_the_map(tmp_path: Path) -> None:
    path = log_of(drive(1.0, 400), tmp_path / "drive.txt")
    replay = receiver.replay_nmea(path)
    suite = receiver.make_receiver_suite(replay)
    lines = suite.verdict.splitlines()
    assert len(lines) <= LINES and max(map(len, lines)) <= LETTERS
    assert lines[0].startswith("Tuning the noise of position by HDOP pays: log-likelihood +")
    assert ["epochs", "400"] in [list(row) for row in suite.tables[-1].cells]
    assert {row.metric for row in suite.rows} >= {"prediction_error", "log_likelihood", "nis"}
    receiver.write_kml(tmp_path / "drive.kml", replay)
    assert "11.0" in (tmp_path / "drive.kml").read_text()
    receiver.draw(tmp_path / "drive.png", replay)
    assert (tmp_path / "drive.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("sparse", [False, True], ids=["few", "too far apart"])
def test_a_log_too_short_to_compare_is_refused_by_name(tmp_path: Path, sparse: bool) -> None:
    epochs = drive(1.0, 400 if sparse else 50)
    far = [each._replace(t=each.t + 20.0 * k * sparse) for k, each in enumerate(epochs)]
    with pytest.raises(ValueError, match=r"short\.nmea: \d+ fixes to score, where the car moves"):
        receiver.replay_nmea(log_of(far, tmp_path / "short.nmea"))


def test_a_log_without_hdop_is_refused(tmp_path: Path) -> None:
    path = log_of([each._replace(hdop=math.nan) for each in drive(0.0, 200)], tmp_path / "a.nmea")
    with pytest.raises(ValueError, match=r"a\.nmea: no fix has an HDOP: expected GGA"):
        receiver.replay_nmea(path)


@pytest.mark.skipif(ABSENT, reason=REASON)
@pytest.mark.parametrize("name", RECORDINGS)
def test_the_recordings_are_answered(name: str) -> None:
    replay = receiver.replay_nmea(RECORDINGS[name])
    lines = receiver._compose_verdict(replay).splitlines()
    assert len(lines) <= LINES and max(map(len, lines)) <= LETTERS
    assert " costs: " in lines[0] if "munich" in name else " changes nothing: " in lines[0]


def test_options_of_a_drive_with_a_gyro_are_refused(tmp_path: Path, run: Run) -> None:
    path = log_of(drive(0.0, 200), tmp_path / "a.nmea")
    status, _, error = run("replay", path, "--until", 3, "--gyro-bias", 4, "--vehicle", "coms")
    assert status == 2 and "gyro_bias, until: of no use to a receiver's log" in error
    status, out, error = run("replay", path, "--vehicle", "coms", "--estimator", "joint")
    assert status == 0 and "says nothing of --vehicle and --estimator" in out, error
    assert "199 s with 200 fixes" in out
