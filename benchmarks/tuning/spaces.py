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


class SearchNumber(NamedTuple):
    """A number that is searched between low and high, on a logarithmic scale, from `start` on.

    name: of the option, behind a dot the place in a list. of: whose option it is, of
    `CELL_WEIGHTS`.
    is_integer: it is an integer. steering: it means something only where the action steers.
    """

    name: str
    start: float
    low: float
    high: float
    of: tuple[str, ...] = ("controller",)
    is_integer: bool = False
    steering: bool = False


_TIME = SearchNumber("disturbance_time", 0.3, 0.03, 3.0, ("filter",))  # s
_LEVELS = (
    SearchNumber("force_sd", 50.0, 10.0, 3e3, ("filter",)),  # N
    SearchNumber("moment_sd", 20.0, 5.0, 3e3, ("filter",)),  # N m
    SearchNumber("bias_sd", 0.01, 1e-4, 0.05, ("filter",)),  # rad/s
    SearchNumber("accel_bias_sd", 0.2, 0.01, 2.0, ("filter",)),  # m/s2
    SearchNumber("bank_sd", 0.01, 1e-4, 0.1, ("filter",)),  # rad
    SearchNumber("accel_y_noise", 0.1, 0.02, 2.0, ("filter",)),  # m/s2
)
_GRIP = SearchNumber("grip", 0.7, 0.3, 1.0)
_FILTER = (*_LEVELS, _TIME, _GRIP)
_LQG = (
    *_LEVELS,
    _TIME._replace(of=("filter", "controller")),
    _GRIP,
    SearchNumber("steer_weight", 100.0, 0.3, 1e3, steering=True),
)
_MPC = (*_LEVELS, _TIME._replace(of=("filter", "controller")), _GRIP)
_ADAPTIVE = (*_LEVELS[:2], _LEVELS[-1], _TIME._replace(of=("filter", "controller")), _GRIP)

SPACES: dict[str, tuple[SearchNumber, ...]] = {
    "two-dof": (
        SearchNumber("gain", 1.0, 0.1, 10.0),
        SearchNumber("pole", POLE, 2.0, 60.0),
        *_FILTER,
    ),
    "model-following": (
        SearchNumber("bandwidth.0", 5.0, 0.5, 50.0),  # rad/s, of the slip
        SearchNumber("bandwidth.1", 5.0, 0.5, 50.0),  # of the yaw rate
        *_FILTER,
    ),
    "esc": (
        SearchNumber("bandwidth", BANDWIDTH, 2.0, 60.0),  # rad/s
        SearchNumber("band", 0.02, 1e-3, 0.1),  # rad/s
        SearchNumber("slip", 0.05, 2e-3, 0.3),  # rad
        *_FILTER,
    ),
    "sliding-mode": (
        SearchNumber("pole", 15.0, 2.0, 60.0),  # rad/s
        SearchNumber("rate", 40.0, 4.0, 400.0),
        SearchNumber("layer", 0.2, 0.02, 2.0),
        *_FILTER,
    ),
    "lqr": _LQG,
    "mpc": (SearchNumber("horizon", 30, 10, 60, is_integer=True), *_MPC),
    "nmpc": (
        SearchNumber("horizon", 0.5, 0.2, 1.0),  # s
        SearchNumber("steer_weight", 10.0, 0.3, 1e3, steering=True),
        *_MPC,
    ),
    "adaptive-lqr": (SearchNumber("steer_weight", 100.0, 0.3, 1e3, steering=True), *_ADAPTIVE),
    "adaptive-nmpc": (
        SearchNumber("horizon", 0.5, 0.2, 1.0),  # s
        SearchNumber("steer_weight", 10.0, 0.3, 1e3, steering=True),
        *_ADAPTIVE,
    ),
    "nominal": _LQG,
    "oracle-parameters-lqr": tuple(
        entry for entry in _LQG if entry.name != "bias_sd"
    ),  # it knows it
}
"""By contestant; all but the rungs, which bring their own, drive on `exact-kf` with all sensors,
the adaptive ones on the filter whose tyres they follow. In the matrix `lqr` has what was found for
`nominal`, which is the same design."""
SLOW = ("mpc", "nmpc", "adaptive-nmpc", "oracle-parameters-lqr")
"""Contestants whose worse trials end after a few seeds."""


def get_space(name: str, kind: str) -> tuple[SearchNumber, ...]:
    """What is searched of a contestant in a class; ValueError for another name or class."""
    check_choice("controller", name, SPACES)
    check_choice("class", kind, KINDS)
    return tuple(number for number in SPACES[name] if kind in STEERING or not number.steering)


def make_options(numbers: tuple[SearchNumber, ...], values: Mapping[str, float]) -> Options:
    """The options of filter and controller with the numbers that were found, by name."""
    options: dict[str, dict[str, Any]] = {"filter": {}, "controller": {}}
    for number in numbers:
        name, _, index = number.name.partition(".")
        value = round(values[number.name]) if number.is_integer else float(values[number.name])
        for part in number.of:
            if index:
                options[part].setdefault(name, []).append(value)
            else:
                options[part][name] = value
    return options
