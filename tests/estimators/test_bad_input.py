"""Bad input is refused with a message that names the thing, or skipped and counted."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs.record import FAST, FAST_WIDTH, PACKET_WIDTH, Log, Record
from sideslip.envs.sensors.link import SlowSensor
from sideslip.estimators import FILTERS, make_estimator
from sideslip.estimators.core.memory import COUNTERS, GAIN
from sideslip.estimators.design.options import OPTIONS
from tests.estimators.dense import WITH_TYRES
from tests.estimators.simulation import CAMERA, FIG7, GPS, simulate

pytestmark = pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")

BOTH = {"camera": CAMERA, "gps": GPS}
SHORT = type(FIG7)(duration=0.3)


NEEDS = ": gate, adapt.* need gains='covariance'"
ACCEL = {"fast": ["gyro", "accel_y"]}
WINDOW = r"s late; delay='{0}' has a window of 0.{1} s \({1} ticks"
ASSUMED: dict[str, Any] = {"delay": "constant", "assumed_delay": 0.512}
LATE_GPS = {"sensors": {"gps": SlowSensor(0.2, (0.3,), jitter=0.2)}, "delay": "buffer"}
MANY_FIXES = {"sensors": {"gps": SlowSensor(0.005, (0.4,))}, "delay": "buffer"}
LARSEN_HDOP: dict[str, Any] = {"slow": "gps", "hdop_table": [(1.0, 1.0), (2.0, 2.0)]}
LARSEN_HDOP |= {"delay": "larsen"}


def camera(late: float, jitter: float = 0.0) -> dict[str, Any]:
    """The option of a camera that is so late (s)."""
    return {"sensors": {"camera": SlowSensor(0.033, (late,), jitter=jitter)}}


@pytest.mark.parametrize(
    ("name", "options", "error", "message"),
    [
        ("multirate", {}, ValueError, "unknown estimator 'multirate'; did you mean"),
        ("kalman9", {}, ValueError, "known: bicycle-kf"),
        ("dakf", {"sensors": None}, ValueError, "dakf needs the slow sensor gps; there is: none"),
        ("multirate-kf", {"sensors": None}, ValueError, "multirate-kf needs .* camera or gps"),
        ("multirate-kf", {"slow": "radar"}, ValueError, "multirate-kf can use camera or gps"),
        ("dakf", {"slow": "camera"}, ValueError, "dakf can use gps"),
        ("bicycle-kf", {"slow": "gps"}, ValueError, "bicycle-kf uses no slow sensor"),
        ("joint", {"q_bias": 1.0, "bias_time": 30.0}, ValueError, "q_bias is not used beside"),
        ("joint", {"q_bank": 1.0}, ValueError, "q_bank is not used beside bank_time, 14 s"),
        ("bicycle-kf", {"q_psi": 1.0}, TypeError, "bicycle-kf: unknown option 'q_psi'"),
        ("dakf", {"wibble": 1, "wobble": 2}, TypeError, "unknown option 'wibble', 'wobble'; known"),
        ("dakf", {"force_sd": 1.0}, TypeError, "dakf: unknown option 'force_sd'"),
        ("dakf", {"force_share": 0.1}, TypeError, "dakf: unknown option 'force_share'"),
        ("exact-kf", {"model_error": 0.3}, TypeError, "exact-kf: unknown option 'model_error'"),
        ("exact-kf", {"fast": ["accel_y"]}, ValueError, "fast is 'gyro' and any of accel_y"),
        ("exact-kf", {"fast": ["gyro", "lidar"]}, ValueError, "got .*'lidar'"),
        ("exact-kf", {"fast": ["gyro", "gyro"]}, ValueError, "fast is"),
        ("exact-kf", {"accel_bias_sd": 0.1}, ValueError, "accel_bias_sd needs accel_y among fast"),
        ("exact-kf", {"bias_sd": -1.0}, ValueError, "bias_sd is in rad/s and not negative"),
        ("exact-kf", {"bias_sd": 0.1, "gains": "periodic"}, ValueError, "no settled gain"),
        ("multirate-kf", {"fast": ["gyro", "accel_y"]}, TypeError, "unknown option 'fast'"),
        ("exact-kf", {"slow": "gps", "camera_yaw_sd": 0.01}, ValueError, "yaw_sd needs camera"),
        ("exact-kf", {"camera_yaw_time": 1.0}, TypeError, "unknown option 'camera_yaw_time'"),
        ("exact-kf", {"steer_offset_sd": 1e-3, "gains": "periodic"}, ValueError, "no settled gain"),
        ("yaw-moment-observer", {"steer_offset_sd": 0.01}, TypeError, "option 'steer_offset_sd'"),
        ("multirate-kf", {"camera_yaw_sd": 0.01}, TypeError, "unknown option 'camera_yaw_sd'"),
        ("bicycle-kf", {"leak": 0.1}, TypeError, "bicycle-kf: unknown option 'leak'"),
        ("bicycle-kf", {"gyro_noise": "loud"}, TypeError, "gyro_noise is a number, got 'loud'"),
        ("course-kf", {"course_noise": -0.1}, ValueError, "course_noise must be positive"),
        ("bicycle-kf", {"prior": {"beta": -1.0}}, ValueError, "prior of beta"),
        ("multirate-kf", {"gains": "random"}, ValueError, "gains is one of periodic, covariance"),
        ("multirate-residual-kf", {"inverse": "left"}, ValueError, "inverse is one of moore-pen"),
        ("multirate-residual-kf", {"gains": "covariance"}, ValueError, "one constant gain"),
        ("exact-kf", {"slow": ["camera", "gps"], "gains": "periodic"}, ValueError, "two slow sens"),
        ("bicycle-kf", {"dt": 0.0}, ValueError, "a tick of 0.0 s"),
        ("dakf", {"leak": -1.0}, ValueError, "leak is in 1/s and not negative"),
        ("dual-rate", {"intersample": "oh", "gains": "from-29"}, ValueError, "from-29"),
        ("multirate-kf", {"dt": 0.01}, ValueError, "camera's period of 0.033 s is no whole number"),
        ("bicycle-kf", {"vehicle": "tank"}, ValueError, "unknown vehicle 'tank'"),
        ("multirate-kf", {"slow": 5}, ValueError, "can use camera or gps, got slow=5"),
        ("single-rate-kf", {"slow": ["camera", "gps"]}, ValueError, "slow is one sensor for betw"),
        ("dakf", {"delay": "lag"}, ValueError, "dakf: delay needs the camera.* got 'lag'"),
        ("bicycle-kf", {"Q": "loud"}, TypeError, "bicycle-kf: Q holds numbers, got 'loud'"),
        ("bicycle-kf", {"prior": 5}, TypeError, "prior is standard deviations by state, got 5"),
        ("bicycle-kf", {"prior": {"beta": "a"}}, TypeError, "prior of beta holds numbers, got 'a'"),
        ("dakf", {"gate": "shut"}, TypeError, "dakf: gate is a number, got 'shut'"),
        ("dakf", {"hdop_table": 5.0}, ValueError, "dakf: hdop_table is 2 to 8 pairs.* got 5.0"),
        ("lob", {"poles": "fast"}, TypeError, "lob: poles holds numbers, got 'fast'"),
        ("lob", {"poles": -1.0}, ValueError, "lob: poles are negative numbers in rad/s, got -1.0"),
        ("lob", {"poles": [-1.0, 0.0]}, ValueError, "negative numbers in rad/s, got .-1.0, 0.0"),
        ("lob", {"poles": [-1.0]}, ValueError, "lob: poles are one for each of beta, gamma, got"),
        ("dual-rate", {"gains": "placed"}, ValueError, "dual-rate: poles are negative.*, got ..$"),
        # sensors that are later than the window
        ("multirate-kf", {"gains": "periodic"} | camera(0.01, jitter=0.02), ValueError, "random"),
        ("multirate-residual-kf", camera(0.05), ValueError, "before the next one"),
        ("exact-kf", camera(0.3), ValueError, "can hold 8"),
        ("exact-kf", LATE_GPS, ValueError, rf"gps can be 0.5 {WINDOW.format('buffer', 496)}"),
        ("exact-kf", {"delay": "stored"} | camera(0.512), ValueError, WINDOW.format("stored", 511)),
        ("exact-kf", ASSUMED | camera(0.0), ValueError, "0.512 s is not within .* of 0.512 s"),
        ("exact-kf", MANY_FIXES, ValueError, "86 samples of gps can come .*'buffer' stores 64"),
        ("exact-kf", {"delay": "larsen"} | camera(0.1), ValueError, "0.1 s late, 4 .* can hold 1"),
        # rules that do not go together
        ("exact-kf", {"delay": "larsen", "gate": 0.99}, ValueError, "delay='larsen' .* no gate"),
        ("exact-kf", LARSEN_HDOP, ValueError, "no hdop_table"),
        ("single-rate-kf", {"delay": "buffer"}, ValueError, "that listen at every tick"),
        ("joint", {"delay": "buffer"}, ValueError, "does not store the noise that noise_time="),
        ("multirate-kf", {"gains": "periodic", "gate": 0.99}, ValueError, f"multirate-kf{NEEDS}"),
        ("multirate-kf", {"gains": "periodic", "adapt": 0.02}, ValueError, NEEDS),
        ("multirate-residual-kf", {"gate": 0.99}, ValueError, NEEDS),
        ("double-layer", {"gate": 0.99}, ValueError, NEEDS),
        ("dual-rate", {"adapt": 0.1}, ValueError, NEEDS),
        ("lob", {"gate": 0.5}, ValueError, NEEDS),
        # tyres as states
        ("exact-kf", WITH_TYRES | {"front_tyres_sd": 0.0}, ValueError, "another tyre's state"),
        ("exact-kf", WITH_TYRES | {"rear_tyres_sd": -1.0}, ValueError, "not negative"),
        ("exact-kf", ACCEL | {"accel_scale_sd": 0.1}, ValueError, "accel_scale_sd needs tyres"),
        ("exact-kf", WITH_TYRES | {"accel_scale_sd": 0.1}, ValueError, "accel_y among fast"),
    ],
)
def test_constructor_errors_name_it(name: Any, options: Any, error: Any, message: Any) -> None:
    with pytest.raises(error, match=message):
        make_estimator(name, **({"sensors": BOTH} | options))


NUMBERS = [key for key, x in OPTIONS.items() if type(x.default) in {int, float}]
NEEDED: dict[str, Any] = {"assumed_delay": {"delay": "constant"}, "model_error": WITH_TYRES}
FORCES = ("force_sd", "moment_sd", "disturbance_time")
NEEDED |= {key: {"disturbances": "forces"} for key in FORCES}


@pytest.mark.parametrize("key", ["gate", *NUMBERS])
def test_every_number_but_one_has_a_limit(key: str) -> None:
    """No option below zero means anything, but a number of satellites that a fix needs."""
    options: dict[str, Any] = NEEDED.get(key, {}) | {key: -1.0}
    if key == "satellites":
        make_estimator("exact-kf", sensors=BOTH, speed=7.0, **options)
        return
    with pytest.raises(ValueError, match=f"exact-kf: {key} .*, got -1.0"):
        make_estimator("exact-kf", sensors=BOTH, speed=7.0, **options)


def test_random_delay_needs_no_option() -> None:
    sensors = {"camera": SlowSensor(0.033, (0.01,), jitter=0.02)}
    for name, rule in (("multirate-kf", GAIN.covariance), ("single-rate-kf", GAIN.table)):
        assert make_estimator(name, sensors=sensors, speed=7.0).filters[0].gain_rule == rule


@pytest.fixture
def log() -> Any:
    return simulate(SHORT, {"camera": CAMERA}, 0)


def test_logs_that_cannot_be_filtered(log: Any) -> None:
    filter_ = make_estimator("multirate-kf", sensors=log.slow)
    record = log.record
    for column in ("gyro", "steer", "wheel_left"):
        record.present = tuple(c for c in FAST._fields if c != column)
        with pytest.raises(ValueError, match=f"multirate-kf needs the column '{column}'"):
            filter_.run(log)
    record.present = ("gyro", "steer", "wheel_left")
    filter_.run(log)  # these are enough
    with pytest.raises(ValueError, match="empty"):
        filter_.run(Record(record.fast[:0], record.packets))
    with pytest.raises(ValueError, match=r"ticks of 0.001 s, the record has 0.01 s"):
        filter_.run(Record(record.fast, record.packets, dt=0.01))
    with pytest.raises(ValueError, match=r"built for the camera .* the reset has"):
        filter_.run(Log(record, {"camera": SlowSensor(0.05)}))


def packet(
    sensor: Any = 0, captured: Any = 0, arrived: Any = None, quality: Any = 1.0, value: Any = 0.01
) -> Any:
    row = np.zeros(PACKET_WIDTH)
    row[:5] = sensor, captured, captured if arrived is None else arrived, quality, 0
    row[5:7] = value
    return row


def counted(filter_: Any, *packets: Any) -> Any:
    """What the counters say after 100 quiet ticks and these packets, apart from zeros."""
    filter_.reset()
    filter_.step(np.zeros((100, FAST_WIDTH)), np.zeros((0, PACKET_WIDTH)))
    before = filter_.x
    for row in packets:
        filter_.update(row)
    used = not np.array_equal(filter_.x, before)
    return {k: v for k, v in filter_.counts.items() if v}, used


@pytest.mark.parametrize("name", list(FILTERS))
def test_rows_that_are_not_finite_are_skipped(name: Any) -> None:
    log = simulate(SHORT, BOTH, 0)
    for column in range(FAST.steer_command):
        rows = log.record.fast.copy()
        rows[150, column] = np.nan
        rows[160, column] = np.inf
        filter_ = make_estimator(name, sensors=BOTH)
        found = filter_.run(Record(rows, log.record.packets))
        assert np.isfinite(found.x).all() and np.isfinite(found.std).all()
        expected = 0
        for f in filter_.filters:  # the driver's inputs once a row, each fast sensor once
            expected += 2 * (column in f.u_column[: f.inputs])
            heard = f.pace == 1  # a single-rate filter samples its gyro every 33 ms
            expected += 2 * heard * (column in f.y_column[: f.fasts])
        assert sum(f.counts[COUNTERS.invalid] for f in filter_.filters) == expected


def test_the_first_course_far_off_sets_the_heading() -> None:
    """A log whose heading does not start at zero; courses are wrapped."""
    for name in ("multirate-kf", "multirate-residual-kf", "course-kf"):
        filter_ = make_estimator(name, sensors={"gps": GPS}, speed=7.0)
        rows = np.zeros((1001, FAST_WIDTH))
        for heading in (2.0, -3.0):
            courses = [
                packet(1, k, value=(heading + 0.01 * (-1) ** k + np.pi) % (2 * np.pi) - np.pi)
                for k in range(0, 1001, 200)
            ]
            estimates = filter_.run(Record(rows, np.array(courses)))
            assert np.abs(estimates["beta"]).max() < 0.02
            assert np.abs(estimates["psi"] - heading).max() < 0.05
