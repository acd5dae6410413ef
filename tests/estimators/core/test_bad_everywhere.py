"""Each filter, whatever it is made of, refuses what is bad or skips and counts it."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs.record import FAST, FAST_WIDTH, PACKET_WIDTH, Record
from sideslip.estimators import FILTERS, make_estimator
from tests.estimators.simulation import simulate
from tests.estimators.test_bad_input import BOTH, SHORT, counted, packet

pytestmark = pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")


def everywhere(name: Any, **options: Any) -> Any:
    told: dict[str, Any] = {"sensors": BOTH, "speed": 7.0}
    return make_estimator(name, **(told | options))


@pytest.mark.parametrize("name", list(FILTERS))
@pytest.mark.parametrize(
    ("option", "value", "error", "message"),
    [
        ("gyro_noise", 0.0, ValueError, "gyro_noise must be positive and finite, got 0.0"),
        ("gyro_noise", -1.0, ValueError, "gyro_noise must be positive and finite, got -1.0"),
        ("gyro_noise", float("nan"), ValueError, "gyro_noise must be positive and finite, got nan"),
        ("psi_noise", float("inf"), ValueError, "psi_noise must be positive and finite, got inf"),
        ("course_noise", [0.1], TypeError, "course_noise is a number, got"),
        ("speed", float("nan"), ValueError, "speed is in m/s and not negative, got nan"),
        ("speed", -0.1, ValueError, "speed is in m/s and not negative, got -0.1"),
        ("speed", float("inf"), ValueError, "speed is in m/s and not negative, got inf"),
        ("dt", -0.001, ValueError, "a tick of -0.001 s"),
        ("satellites", None, TypeError, "satellites is a number, got None"),
        ("gate", 1.5, ValueError, "gate is a probability between 0 and 1, got 1.5"),
        ("adapt", -0.1, ValueError, "adapt is a share from 0 to 1, got -0.1"),
        ("delay", "never", ValueError, "delay is one of clone, ignore, .*, got 'never'"),
        ("hdop_table", [(1.0, 1.0)], ValueError, "hdop_table is 2 to 8 pairs"),
        ("prior", {"nothing": 1.0}, ValueError, "has no state 'nothing'; it has"),
        ("wibble", 1, TypeError, "unknown option 'wibble'; known: "),
    ],
)
def test_every_filter_refuses_a_bad_option(
    name: Any, option: Any, value: Any, error: Any, message: Any
) -> None:
    with pytest.raises(error, match=rf"{name}[: ].*{message}"):
        everywhere(name, **{option: value})


@pytest.mark.parametrize("name", list(FILTERS))
def test_every_filter_refuses_a_q_that_is_no_covariance(name: Any) -> None:
    states = everywhere(name).names
    n = len(states)
    for Q, message in (
        (np.eye(n + 1), rf"Q has shape \({n}, {n}\) or \({n},\), got \({n + 1}, {n + 1}\)"),
        (np.ones(n + 1), rf"Q has shape .* got \({n + 1},\)"),
        (np.ones((n, n, n)), r"Q has shape"),
        (-np.eye(n), "Q is indefinite: its least eigenvalue is -1"),
        (np.diag([float("nan")] * n), "Q is not finite"),
        (np.diag([float("inf")] * n), "Q is not finite"),
    ):
        with pytest.raises(ValueError, match=f"{name}: {message}"):
            everywhere(name, Q=Q)
    if n > 1:
        skew = np.eye(n) + np.eye(n, k=1)
        with pytest.raises(ValueError, match=f"{name}: Q is not symmetric"):
            everywhere(name, Q=skew)
        with pytest.raises(ValueError, match=f"{name}: Q is indefinite"):
            everywhere(name, Q=2.0 * np.ones((n, n)) - np.eye(n))
    with pytest.raises(ValueError, match=f"{name}: Q is indefinite"):
        everywhere(name, **{f"q_{states[0]}": -1.0})
    with pytest.raises(ValueError, match=f"{name}: the prior of {states[0]} is a standard"):
        everywhere(name, prior={states[0]: float("nan")})


@pytest.mark.parametrize("name", list(FILTERS))
def test_every_filter_refuses_arrays_of_another_shape(name: Any) -> None:
    filter_ = everywhere(name)
    filter_.predict(np.zeros(FAST_WIDTH))
    before = filter_.get_state()
    for rows in (np.zeros((2, FAST_WIDTH + 1)), np.zeros(FAST_WIDTH), np.zeros((1, 1, FAST_WIDTH))):
        with pytest.raises(ValueError, match=rf"fast rows have shape \(k, {FAST_WIDTH}\), got"):
            filter_.step(rows, np.zeros((0, PACKET_WIDTH)))
    for packets in (np.zeros((1, PACKET_WIDTH - 1)), np.zeros(PACKET_WIDTH)):
        with pytest.raises(ValueError, match=rf"packets have shape \(k, {PACKET_WIDTH}\), got"):
            filter_.step(np.zeros((1, FAST_WIDTH)), packets)
    with pytest.raises(ValueError, match=r"packets have shape \(k, 11\), got \(1, 10\)"):
        filter_.update(np.zeros(PACKET_WIDTH - 1))
    with pytest.raises(ValueError, match=r"fast rows have shape \(k, 12\), got \(1, 3, 4\)"):
        filter_.predict(np.zeros((3, 4)))  # twelve numbers, but no row
    with pytest.raises(ValueError):
        filter_.predict(["fast"] * FAST_WIDTH)
    assert filter_.get_state().tobytes() == before.tobytes()


@pytest.mark.parametrize("name", list(FILTERS))
def test_every_filter_counts_what_it_skips(name: Any) -> None:
    """A packet of no sensor of ours for all; other faults where the sensor is the filter's."""
    filter_ = everywhere(name)
    assert counted(filter_, packet(sensor=7, captured=66)) == ({"unknown": 1}, False)
    for row in (packet(np.nan, 66), packet(0, 1e300), packet(1, 0, np.inf)):
        assert counted(filter_, row) == ({"invalid": 1}, False)
    for code, sensor in enumerate(("camera", "gps")):
        for row, counter in (
            (packet(code, 0, value=np.nan), "invalid"),
            (packet(code, 100_000_200), "future"),
            (packet(code, 0, 120), "future"),
            (packet(code, -6600), "refused"),
            (packet(code, 0, quality=0.0), "poor"),
            (packet(code, 7), "unknown"),
            (packet(code, 33.5), "unknown"),
        ):
            ours = sensor in filter_.sensors
            assert counted(filter_, row) == ({counter: 1} if ours else {}, False)


@pytest.mark.parametrize("name", list(FILTERS))
@pytest.mark.parametrize("speed", [0.0, None])
def test_a_car_that_stands_is_no_division_by_zero(name: Any, speed: Any) -> None:
    """Told a speed of zero, or with wheels that stand; and then drive, and stand again."""
    filter_ = make_estimator(name, sensors=BOTH, speed=speed)
    log = simulate(SHORT, BOTH, 0)
    rows = np.concatenate([log.record.fast] * 3)
    still = np.abs(np.arange(len(rows)) - len(rows) // 2) > 150
    rows[still, FAST.wheel_left] = rows[still, FAST.wheel_right] = 0.0
    found = filter_.run(Record(rows, log.record.packets))
    assert np.isfinite(found.x).all() and np.isfinite(found.std).all()
    assert (found.std >= 0.0).all()
