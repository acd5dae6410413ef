"""A latency that is found while driving: where the log tells it, and only there."""

import itertools
from typing import Any

import numpy as np
import pytest

from sideslip.envs.record import FAST, PACKET, PACKET_WIDTH, Log, Record
from sideslip.envs.recordings.log_file import read_parts
from sideslip.estimators import make_estimator
from sideslip.estimators.delayed_channels import _LatencySearch
from tests.estimators.dense import WITH_TYRES
from tests.estimators.simulation import CAMERA, FIG7, simulate
from tests.estimators.test_frame import drive
from tests.estimators.test_late import later

FIND = {"gyro": "find"}
FACTS: dict[str, Any] = {"sensors": {"camera": CAMERA}, "speed": FIG7.speed}


def joint(front: float, rear: float, **options: Any) -> Any:
    """Its nominal car has other tyres than the true one by these factors."""
    car = FIG7.truth.scale_stiffness(front, rear)
    return make_estimator("exact-kf", vehicle=car, **WITH_TYRES, **FACTS, **options)


TYRES, LATE = ((1.0, 1.0), (0.7, 1.3), (1.4, 0.7)), (0.0, 0.013, 0.06, 0.1)
QUICK = {(TYRES[0], 0.0), (TYRES[2], 0.06)}
SLOW = [pair for pair in itertools.product(TYRES, LATE) if pair not in QUICK]


@pytest.mark.parametrize(
    ("tyres", "late"),
    [*sorted(QUICK), *(pytest.param(*pair, marks=pytest.mark.long) for pair in SLOW)],
)
def test_it_finds_the_latency_whatever_the_tyres(tyres: tuple[float, float], late: float) -> None:
    filter_ = joint(*tyres, latency=FIND)
    log = later(simulate(FIG7, FACTS["sensors"], 0), {"gyro": late} if late else {})
    estimates = filter_.run(log)
    off = filter_.latency["gyro"] - late
    assert filter_.latency_sd < 0.003 and abs(off) <= max(4.0 * filter_.latency_sd, 0.001)
    plain = joint(*tyres)
    punctual = plain.run(simulate(FIG7, FACTS["sensors"], 0))
    if late == 0.0:
        assert (estimates.x == punctual.x).all()
    squares = [
        np.mean((each["beta"] - log.truth["beta"])[2000:] ** 2) for each in (estimates, punctual)
    ]
    assert squares[0] < 1.2 * squares[1]


@pytest.mark.parametrize("dt", [0.1, 0.25])
def test_rows_too_far_apart_are_refused(dt: float) -> None:
    with pytest.raises(ValueError, match=f"rows every {dt:g} s tell nothing: say the latency"):
        _LatencySearch((FAST.gyro,), dt)


@pytest.mark.parametrize("least", [0.0, 3.2, 37.3, 62.6, 118.4, 120.0])
def test_between_the_lags_that_are_tried_a_parabola_has_the_least(least: float) -> None:
    search = _LatencySearch((FAST.gyro,), 0.001)
    lag, bend, _ = search._minimise_nis(lambda lag: 7.0 + 0.25 * (lag - least) ** 2)
    assert lag == round(least) and bend == pytest.approx(0.5)


def straight(rows: int) -> Log:
    """A car on a straight road: gyro and camera have noise, nothing turns."""
    rng = np.random.default_rng(0)
    fast = np.zeros((rows, len(FAST)))
    fast[:, FAST.wheel_left] = fast[:, FAST.wheel_right] = FIG7.speed
    fast[:, FAST.gyro] = 0.005 * rng.standard_normal(rows)
    packets = np.zeros((rows // 33, PACKET_WIDTH))
    packets[:, PACKET.captured] = packets[:, PACKET.arrived] = 33.0 * np.arange(len(packets))
    packets[:, PACKET.quality] = 1.0
    packets[:, PACKET.value] = 3.5e-3 * rng.standard_normal(len(packets))
    packets[:, PACKET.value + 1] = 0.02 * rng.standard_normal(len(packets))
    return Log(Record(fast, packets), FACTS["sensors"])


def test_it_leaves_alone_what_a_log_cannot_tell_and_goes_on_looking() -> None:
    """A straight road has no latency; where the car turns at last it is found."""
    filter_, still = joint(1.0, 1.0, latency=FIND), straight(9900)
    filter_.run(still)
    assert filter_.latency == {"gyro": 0.0} and filter_.latency_sd == np.inf
    turn = simulate(FIG7, FACTS["sensors"], 0).record
    packets = turn.packets.copy()
    packets[:, [PACKET.captured, PACKET.arrived]] += 9900.0
    both = Record(
        np.concatenate([still.record.fast, turn.fast]),
        np.concatenate([still.record.packets, packets]),
    )
    filter_.run(later(Log(both, still.slow), {"gyro": 0.06}))
    assert filter_.latency["gyro"] == pytest.approx(0.06, abs=0.003)


@pytest.mark.parametrize("late", [0.0, 0.1])
def test_a_gps_alone_finds_a_gyro_that_is_far_too_late(late: float) -> None:
    """Its optimum is flat, but no latency is surely worse."""
    table, truth, car = drive()
    gyro = table.yaw_rate_radps.shift(round(late / 0.01)).bfill()
    log = read_parts(table.assign(yaw_rate_radps=gyro))[0][0]
    errors = []
    for latency in (FIND, {"gyro": late}):
        filter_ = make_estimator(
            "joint", vehicle=car, sensors=log.slow, dt=log.record.dt, latency=latency
        )
        error = (filter_.run(log)["beta"] - truth)[1000:]
        errors.append(np.sqrt(np.mean(error**2)))
    assert errors[0] < 1.2 * errors[1]
