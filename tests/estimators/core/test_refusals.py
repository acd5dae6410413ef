"""Options and sensors that a filter cannot have are refused when it is built, with the reason."""

import functools
import itertools
from typing import Any

import pytest

from sideslip.envs.sensors.link import SlowSensor
from sideslip.estimators import make_estimator
from tests.estimators.dense import WITH_TYRES
from tests.estimators.simulation import CAMERA, FIG7, GPS

SEEN: dict[str, Any] = {"camera": CAMERA}


def call(name: str, sensors: Any = None, **options: Any) -> Any:
    sensors = {"camera": CAMERA, "gps": GPS} if sensors is None else sensors
    return functools.partial(make_estimator, name, sensors=sensors, speed=FIG7.speed, **options)


exact = functools.partial(call, "exact-kf")
joint = functools.partial(call, "exact-kf", slow=["camera", "gps"], **WITH_TYRES)
NEEDS = ": gate, adapt.* need gains='covariance'"
BETWEEN_0_AND_1 = "gate is a probability between 0 and 1, got"
NAN = float("nan")
REFUSED: dict[str, list[Any]] = {
    # sensors that are later than the window
    r"exact-kf: the gps can be 0.5 s late; delay='buffer' has a window of 0.496 s \(496 t": [
        exact({"gps": SlowSensor(0.2, (0.3,), jitter=0.2)}, delay="buffer")
    ],
    r"the camera can be 0.512 s late; delay='stored' has a window of 0.511 s \(511 ticks": [
        exact({"camera": SlowSensor(0.033, (0.512,))}, delay="stored")
    ],
    r"assumed_delay of 0.512 s is not within the window of 0.512 s \(512 ticks\)": [
        exact({"camera": SlowSensor(0.033)}, delay="constant", assumed_delay=0.512)
    ],
    "86 samples of gps can come within the longest delay; delay='buffer' stores 64": [
        exact({"gps": SlowSensor(0.005, (0.4,))}, delay="buffer")
    ],
    "the camera can be 0.1 s late, 4 of its periods .* delay='larsen' can hold 1": [
        exact({"camera": SlowSensor(0.033, (0.100,))}, delay="larsen")
    ],
    # rules that do not go together
    "delay='larsen' weighs a sample before it is here, so it takes no gate": [
        exact(SEEN, delay="larsen", gate=0.99)
    ],
    "no hdop_table": [
        exact({"gps": SlowSensor(0.2, (0.1,))}, delay="larsen", hdop_table=[(1.0, 1.0), (2.0, 2.0)])
    ],
    "delay='buffer' is for filters that listen at every tick": [
        call("single-rate-kf", SEEN, delay="buffer")
    ],
    "does not store the noise that noise_time=": [call("joint", SEEN, delay="buffer")],
    f"multirate-kf{NEEDS}": [
        call("multirate-kf", gains="periodic", gate=0.99),
        call("multirate-kf", gains="periodic", adapt=0.02),
    ],
    f"multirate-residual-kf{NEEDS}": [call("multirate-residual-kf", gate=0.99)],
    f"double-layer{NEEDS}": [call("double-layer", gate=0.99)],
    f"dual-rate{NEEDS}": [call("dual-rate", adapt=0.1)],
    f"lob{NEEDS}": [call("lob", gate=0.5)],
    BETWEEN_0_AND_1: [exact(gate=gate) for gate in (0.0, 1.0, -0.5, 2.0, NAN)],
    "adapt is a share from 0 to 1, got": [exact(adapt=adapt) for adapt in (-0.1, 1.0, NAN)],
    # tyres as states
    "another tyre's state": [joint(front_tyres_sd=0.0)],
    "not negative": [joint(rear_tyres_sd=-1.0)],
    "accel_scale_sd needs tyres": [exact(fast=["gyro", "accel_y"], accel_scale_sd=0.1)],
    "accel_scale_sd needs accel_y among fast": [joint(accel_scale_sd=0.1)],
}


@pytest.mark.parametrize(
    ("build", "message"),
    [
        pytest.param(build, message, id=f"{build.args[0]}: {message}")
        for message, build in itertools.chain.from_iterable(
            [(message, build) for build in builds] for message, builds in REFUSED.items()
        )
    ],
)
def test_what_a_filter_cannot_have_is_refused(build: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build()
