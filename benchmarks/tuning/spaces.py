"""What is searched of each contestant of the matrix, with its range: one table."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from ...agents.controllers.esc import BANDWIDTH
from ...agents.design.pi import POLE
from ...agents.tuned import Options
from ...envs.arguments import check_choice

KINDS = ("coms-model", "coms-zero-slip", "car-yaw", "car-steering")
"""The classes of contests."""
STEERING = ("coms-model", "car-steering")
"""Those in which the action steers too."""


class Number(NamedTuple):
    """A number that is searched between low and high, on a logarithmic scale, from `start` on.

    name: of the option, behind a dot the place in a list. of: whose option it is, of `PARTS`.
    whole: it is an integer. steering: it means something only where the action steers.
    """

    name: str
    start: float
    low: float
    high: float
    of: tuple[str, ...] = ("controller",)
    whole: bool = False
    steering: bool = False


_TIME = Number("disturbance_time", 0.3, 0.03, 3.0, ("filter",))  # s
_LEVELS = (
    Number("force_sd", 50.0, 10.0, 3e3, ("filter",)),  # N
    Number("moment_sd", 20.0, 5.0, 3e3, ("filter",)),  # N m
    Number("bias_sd", 0.01, 1e-4, 0.05, ("filter",)),  # rad/s
    Number("accel_bias_sd", 0.2, 0.01, 2.0, ("filter",)),  # m/s2
    Number("bank_sd", 0.01, 1e-4, 0.1, ("filter",)),  # rad
    Number("accel_y_noise", 0.1, 0.02, 2.0, ("filter",)),  # m/s2
)
_GRIP = Number("grip", 0.7, 0.3, 1.0)
_FILTER = (*_LEVELS, _TIME, _GRIP)
_LQG = (
    *_LEVELS,
    _TIME._replace(of=("filter", "controller")),
    _GRIP,
    Number("steer_weight", 100.0, 0.3, 1e3, steering=True),
)
_MPC = (*_LEVELS, _TIME._replace(of=("filter", "controller")), _GRIP)
_ADAPTIVE = (*_LEVELS[:2], _LEVELS[-1], _TIME._replace(of=("filter", "controller")), _GRIP)

SPACES: dict[str, tuple[Number, ...]] = {
    "two-dof": (Number("gain", 1.0, 0.1, 10.0), Number("pole", POLE, 2.0, 60.0), *_FILTER),
    "model-following": (
        Number("bandwidth.0", 5.0, 0.5, 50.0),  # rad/s, of the slip
        Number("bandwidth.1", 5.0, 0.5, 50.0),  # of the yaw rate
        *_FILTER,
    ),
    "esc": (
        Number("bandwidth", BANDWIDTH, 2.0, 60.0),  # rad/s
        Number("band", 0.02, 1e-3, 0.1),  # rad/s
        Number("slip", 0.05, 2e-3, 0.3),  # rad
        *_FILTER,
    ),
    "sliding-mode": (
        Number("pole", 15.0, 2.0, 60.0),  # rad/s
        Number("rate", 40.0, 4.0, 400.0),
        Number("layer", 0.2, 0.02, 2.0),
        *_FILTER,
    ),
    "lqr": _LQG,
    "mpc": (Number("horizon", 30, 10, 60, whole=True), *_MPC),
    "nmpc": (
        Number("horizon", 0.5, 0.2, 1.0),  # s
        Number("steer_weight", 10.0, 0.3, 1e3, steering=True),
        *_MPC,
    ),
    "adaptive-lqr": (Number("steer_weight", 100.0, 0.3, 1e3, steering=True), *_ADAPTIVE),
    "adaptive-nmpc": (
        Number("horizon", 0.5, 0.2, 1.0),  # s
        Number("steer_weight", 10.0, 0.3, 1e3, steering=True),
        *_ADAPTIVE,
    ),
    "nominal": _LQG,
    "oracle-parameters-lqr": tuple(each for each in _LQG if each.name != "bias_sd"),  # it knows it
}
"""By contestant; all but the rungs, which bring their own, drive on `exact-kf` with all sensors,
the adaptive ones on the filter whose tyres they follow. In the matrix `lqr` has what was found for
`nominal`, which is the same design."""
SLOW = ("mpc", "nmpc", "adaptive-nmpc", "oracle-parameters-lqr")
"""Contestants whose worse trials end after a few seeds."""


def space(name: str, kind: str) -> tuple[Number, ...]:
    """What is searched of a contestant in a class; ValueError for another name or class."""
    check_choice("controller", name, SPACES)
    check_choice("class", kind, KINDS)
    return tuple(each for each in SPACES[name] if kind in STEERING or not each.steering)


def options_of(numbers: tuple[Number, ...], found: Mapping[str, float]) -> Options:
    """The options of filter and controller with the numbers that were found, by name."""
    options: dict[str, dict[str, Any]] = {"filter": {}, "controller": {}}
    for number in numbers:
        name, _, place = number.name.partition(".")
        value = round(found[number.name]) if number.whole else float(found[number.name])
        for part in number.of:
            if place:
                options[part].setdefault(name, []).append(value)
            else:
                options[part][name] = value
    return options
