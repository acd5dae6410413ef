"""What a user may say about a filter: options, each checked where it comes in."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from ..core.memory import KNOTS, ROWS
from .checks import check_covariance
from .models import Model

Array = npt.NDArray[np.float64]

NOISE = {
    "gyro_noise": 0.005,  # rad/s
    "psi_noise": 3.5e-3,  # rad
    "y_l_noise": 0.02,  # m
    "course_noise": math.radians(0.14),  # rad at 60 km/h, growing as 1/V
}
MORE_NOISE = {
    "accel_y_noise": 0.1,  # m/s2
    "roll_rate_noise": 0.005,  # rad/s
    "wheel_noise": 0.015,  # m/s, of the mean of both front wheels
    "gps_speed_noise": 0.05,  # m/s
}
DISTURBANCE = {"force_sd": 50.0, "moment_sd": 20.0, "disturbance_time": 0.3}  # N, N m, s
PRIOR = {
    "beta": 0.02,
    "gamma": 0.05,
    "psi": 0.05,
    "y_l": 0.3,
    "psi_late": 0.05,
    "y_l_late": 0.3,
    "v_x": 0.1,
    "v_y": 0.1,
    "phi": 0.02,
    "phi_rate": 0.05,
    "F_yf": 500.0,
    "F_yr": 500.0,
    "d1": 0.1,
    "d2": 1.0,
    "d3": 0.1,
    "d": 1.0,
}


class Options:
    """Options that must all be asked for."""

    def __init__(self, name: str, options: Mapping[str, Any]) -> None:
        self.name, self._left, self._known = name, dict(options), list[str]()

    def has(self, key: str) -> bool:
        """Whether the option was given and is not taken yet."""
        return key in self._left

    def take(self, key: str, default: Any) -> Any:
        """The option, or its default."""
        self._known.append(key)
        return self._left.pop(key, default)

    def one_of(self, key: str, default: str, known: Sequence[str]) -> str:
        """An option that is one of some words; ValueError for another."""
        value = self.take(key, default)
        if value not in known:
            raise ValueError(
                f"{self.name}: {key} is one of {', '.join(filter(None, known))}, got {value!r}"
            )
        return str(value)

    def number(self, key: str, default: float) -> float:
        """A number; TypeError for anything else."""
        value = self.take(key, default)
        try:
            return float(value)
        except (TypeError, ValueError):
            raise TypeError(f"{self.name}: {key} is a number, got {value!r}") from None

    def positive(self, key: str, default: float) -> float:
        """A number above zero; TypeError or ValueError for anything else."""
        number = self.number(key, default)
        if not (number > 0.0 and math.isfinite(number)):
            raise ValueError(f"{self.name}: {key} must be positive and finite, got {number!r}")
        return number

    def done(self) -> None:
        """TypeError for options that nothing asked for."""
        if self._left:
            raise TypeError(
                f"{self.name} has no option {', '.join(map(repr, sorted(self._left)))}; "
                f"it has: {', '.join(sorted(self._known))}"
            )


def process_noise(
    name: str, states: Sequence[str], tuning: Mapping[str, float], told: Options
) -> Array:
    """Q (n, n) per second of all states, those of a second layer behind the first's."""
    n = len(states)
    Q: Array = np.diag([float(tuning.get(state, 0.0)) for state in states])
    whole = told.take("Q", None)
    if whole is not None:
        given = np.array(whole, np.float64)
        Q = np.diag(given) if given.ndim == 1 else given
        if Q.shape != (n, n):
            raise ValueError(f"{name}: Q has shape ({n}, {n}) or ({n},), got {np.shape(whole)}")
    for i, state in enumerate(states):
        Q[i, i] = told.number(f"q_{state}", Q[i, i])
    check_covariance(f"{name}: Q", Q)
    return Q


def noise_levels(name: str, forces: bool, told: Options) -> dict[str, float]:
    """Standard deviations as `write_model` takes them."""
    noise = {}
    for key, default in (NOISE | MORE_NOISE).items():
        if key == "course_noise" and told.has(key):
            noise["course_fixed"] = told.positive(key, default)
        noise[key.removesuffix("_noise")] = told.positive(key, default)
    if forces:
        keys = zip(("force", "moment", "time"), DISTURBANCE.items(), strict=True)
        noise |= {short: told.positive(key, default) for short, (key, default) in keys}
    return noise


def prior_variances(
    name: str, model: Model, noise: Mapping[str, float], prior: Mapping[str, float]
) -> list[float]:
    """The states' variances at the start."""
    sd = PRIOR | {"F_d": noise.get("force", 0.0), "N_d": noise.get("moment", 100.0)}
    for state, value in prior.items():
        if not (float(value) >= 0.0 and math.isfinite(value)):
            raise ValueError(f"{name}: the prior of {state} is a standard deviation, got {value!r}")
        sd[state] = float(value)
    return [sd[state] ** 2 for state in model.names]


def check_prior(name: str, states: Sequence[str], prior: Mapping[str, float]) -> None:
    """ValueError for the prior of a state that is not there."""
    for state in prior:
        if state not in states:
            raise ValueError(f"{name} has no state {state!r}; it has: {', '.join(states)}")


def poles_of(name: str, default: tuple[float, ...], told: Options) -> tuple[float, ...]:
    """Poles in rad/s; ValueError unless all are negative and finite."""
    poles = tuple(float(pole) for pole in told.take("poles", default))
    if not all(pole < 0.0 and math.isfinite(pole) for pole in poles):
        raise ValueError(f"{name}: poles are negative numbers in rad/s, got {poles}")
    return poles


def hdop_table(
    name: str, default: tuple[tuple[float, float], ...], told: Options
) -> list[tuple[float, float]]:
    """Knots (HDOP, factor on the GPS's noise), or none; ValueError for a table that is none."""
    table = told.take("hdop_table", default)
    if table is None or table == ():
        return []
    knots = [(float(hdop), float(factor)) for hdop, factor in table]
    rising = all(a[0] < b[0] for a, b in itertools.pairwise(knots))
    if not (2 <= len(knots) <= KNOTS and rising and all(factor > 0.0 for _, factor in knots)):
        raise ValueError(
            f"{name}: hdop_table is 2 to {KNOTS} pairs (HDOP, factor) with rising HDOP and "
            f"positive factors, got {table!r}"
        )
    return knots


def gates(name: str, told: Options) -> list[float]:
    """The largest NIS by dimension for the option `gate`, a probability; zeros without one."""
    share = told.take("gate", None)
    if share is None:
        return [0.0] * (ROWS + 1)
    if not 0.0 < float(share) < 1.0:
        raise ValueError(f"{name}: gate is a probability between 0 and 1, got {share!r}")
    return [0.0, *map(float, chi2.ppf(float(share), np.arange(1, ROWS + 1)))]
