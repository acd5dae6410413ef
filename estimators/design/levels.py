"""A filter's noise levels: sensors, disturbances, Q, and deviations at the start."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...envs.record import Array
from ..core.memory import N_KNOTS
from ..filters import FilterDefinition
from ..matrices import check_covariance
from .measurements import COURSE_SPEED, MEASUREMENTS
from .models import STATES, TYRES
from .options import OptionReader

_ROWS = [row for sensor in MEASUREMENTS.values() for row in sensor.rows]
_VELOCITIES = [row for sensor in MEASUREMENTS.values() for row in sensor.velocities]
NOISE = {"gyro_noise": 0.005} | {f"{row.noise}_noise": row.sd for row in _ROWS}  # gyro: rad/s
EXTRA_NOISE = {
    "accel_y_noise": 0.1,  # m/s2
    "roll_rate_noise": 0.005,  # rad/s
    "wheel_noise": 0.015,  # m/s, of the mean of both front wheels
} | {f"{row.noise}_noise": row.sd for row in _VELOCITIES}
MAX_MEMBERS = 8
N_IMM_MEMBERS = 4  # members
DISTURBANCE = {"force_sd": 50.0, "moment_sd": 20.0, "disturbance_time": 0.3}  # N, N m, s


def parse_noise(forces: bool, reader: OptionReader) -> tuple[dict[str, float], dict[str, float]]:
    """Parse the standard deviations of sensors and disturbances.

    Args:
        forces: Whether the disturbances are a force and a moment.
        reader: Options of the filter.

    Returns:
        `FilterConfig.noise` and `FilterConfig.noise_over_speed`.
    """
    speed_dependent = [
        row.noise for row in _ROWS if row.over_speed and f"{row.noise}_noise" not in reader
    ]
    levels = NOISE | EXTRA_NOISE
    noise = {
        key.removesuffix("_noise"): reader.read_positive(key, sd) for key, sd in levels.items()
    }
    if forces:
        keys = zip(("force", "moment", "time"), DISTURBANCE.items(), strict=True)
        noise |= {short: reader.read_positive(key, default) for short, (key, default) in keys}
    return noise, {name: noise[name] * COURSE_SPEED for name in speed_dependent}


def parse_hdop_table(
    row: FilterDefinition, reader: OptionReader
) -> tuple[tuple[float, float], ...]:
    """Parse the factors on the GPS's noise.

    Args:
        row: Definition of the filter.
        reader: Options of the filter.

    Returns:
        Knots (HDOP, factor), or none.

    Raises:
        reader.make_error: The ValueError for a table that is no such pairs.
    """
    table = reader.read_value("hdop_table", row.hdop)
    if table is None or (isinstance(table, tuple) and not table):
        return ()
    knots = reader.read_array("hdop_table", table)
    is_valid = knots.ndim == 2 and knots.shape[1] == 2 and 2 <= len(knots) <= N_KNOTS
    if not (is_valid and (np.diff(knots[:, 0]) > 0.0).all() and (knots[:, 1] > 0.0).all()):
        expected = f"is 2 to {N_KNOTS} pairs (HDOP, factor) with rising HDOP and positive factors"
        raise reader.make_error("hdop_table", expected, table)
    return tuple((float(hdop), float(factor)) for hdop, factor in knots)


def parse_bank(
    states: Sequence[str], forces: bool, delay: str, reader: OptionReader
) -> dict[str, Any]:
    """Parse the options of a bank of filters.

    Args:
        states: Names of the filter's states.
        forces: Whether the disturbances are a force and a moment.
        delay: Rule for late samples.
        reader: Options of the filter.

    Returns:
        `members`, `levels` and `sudden` of a `FilterConfig`.

    Raises:
        reader.make_error: The ValueError for a value out of range or without what it needs.
    """
    value = reader.read_value("levels", (1.0,))
    levels = reader.read_array("levels", value)
    pairs = levels.reshape(-1, 1).repeat(2, 1) if levels.ndim < 2 else levels
    fits = pairs.shape[1:] == (2,) and 1 <= len(pairs) <= MAX_MEMBERS
    if not (fits and (pairs > 0.0).all() and np.isfinite(pairs).all()):
        raise reader.make_error(
            "levels", f"are 1 to {MAX_MEMBERS} positive factors or pairs", value
        )
    expected = f"is a number of filters from 1 to {MAX_MEMBERS}"
    count = reader.read_number(
        "members", len(pairs), expected, lambda v: v in range(1, MAX_MEMBERS + 1)
    )
    if count > 1 and TYRES[0] not in states:
        raise reader.make_error("members", "is 1 where tyres are known", count)
    if (pairs != 1.0).any() and not (forces and 1 < count >= len(pairs)):
        raise reader.make_error("levels", "need disturbances='forces' and a member each", value)
    sudden = bool(reader.read_value("sudden", False))
    if sudden and not (count == 1 and TYRES[0] in states and forces and delay == "clone"):
        expected = "needs unknown tyres, disturbances='forces', delay='clone', no members or levels"
        raise reader.make_error("sudden", expected, sudden)
    return {"members": N_IMM_MEMBERS if sudden else int(count), "levels": pairs, "sudden": sudden}


def parse_process_noise(
    states: Sequence[str], tuning: Mapping[str, float], reader: OptionReader
) -> Array:
    """Parse Q: the tuning's or the option's, with single states' on its diagonal.

    Args:
        states: Names of the filter's states.
        tuning: Process noise per second by state.
        reader: Options of the filter.

    Returns:
        Q per second, shape (n, n).

    Raises:
        ValueError: Q has another shape; `check_covariance` refuses what is no covariance.
    """
    n, matrix = len(states), reader.read_value("Q", None)
    tuned_diagonal = [tuning.get(state, 0.0) for state in states]
    Q = reader.read_array("Q", tuned_diagonal if matrix is None else matrix)
    if Q.shape not in ((n,), (n, n)):
        raise ValueError(f"{reader.name}: Q has shape ({n}, {n}) or ({n},), got {Q.shape}")
    Q = np.diag(Q) if Q.ndim == 1 else Q
    for i, state in enumerate(states):
        Q[i, i] = reader.read_number(f"q_{state}", float(Q[i, i]))
    check_covariance(f"{reader.name}: Q", Q)
    return Q


def parse_prior(
    states: Sequence[str],
    noise: Mapping[str, float],
    biases: Mapping[str, float],
    reader: OptionReader,
) -> dict[str, float]:
    """Parse the standard deviations of all states at the start.

    Args:
        states: Names of the filter's states.
        noise: Standard deviations of sensors and disturbances.
        biases: Standard deviations of the biases by state.
        reader: Options of the filter.

    Returns:
        Standard deviation by state, in the state's unit.

    Raises:
        TypeError: The option is no mapping.
        ValueError: A state is unknown.
        reader.make_error: The ValueError for a value that is no standard deviation.
    """
    deviations = {state: STATES[state].prior for state in states} | dict(biases)
    if "force" in noise:
        deviations |= {"F_d": noise["force"], "N_d": noise["moment"]}
    prior = reader.read_value("prior", {})
    if not isinstance(prior, Mapping):
        raise TypeError(f"{reader.name}: prior is standard deviations by state, got {prior!r}")
    for state, value in prior.items():
        if state not in states:
            known = ", ".join(states)
            raise ValueError(
                f"{reader.name} has no state {state!r}; it has: {known}; prior={prior}"
            )
        sd = reader.read_array(f"the prior of {state}", value)
        if sd.ndim > 0 or not 0.0 <= sd < math.inf:
            raise reader.make_error(f"the prior of {state}", "is a standard deviation", value)
        deviations[state] = float(sd)
    return deviations
