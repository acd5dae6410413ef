"""The learned estimator: a filter, and a network that corrects its sideslip angle."""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...envs.record import PACKET_WIDTH, Array
from ...envs.sensors.link import SlowSensor
from ...envs.ticks import TICK
from ...envs.vehicle.vehicle import Vehicle
from ..core.memory import FILTER
from ..entry import compile_call
from ..estimator import Estimator
from ..make import make_estimator
from . import kernel
from .files import Correction, load_correction
from .kernel import EXAMPLE, compute_memory_size, filter_and_correct, make_net, reset_memory


class LearnedEstimator:
    """A filter whose beta and its deviation a network corrects, as an `EstimatorLike`.

    Every 10 ticks the network reads what the filter and the fast sensors gave in the last 0.4 s,
    its memory, and gives what is added to beta until the next time, and the standard deviation of
    the sum; the other states are the filter's. Where a number that it reads is not finite, beta is
    the filter's own.

    Args:
        base: The filter.
        correction: Network and card.
        vehicle: The filter's vehicle, whose mass the network reads.

    Attributes:
        net: The correction as compiled code takes it.
        memory: Its memory, shape (memory_size,).

    Raises:
        ValueError: The correction was made for another filter, other states or another tick.
    """

    def __init__(self, base: Estimator, correction: Correction, vehicle: Vehicle) -> None:
        card, base_states = correction.card, base.names[: int(base.filters[0].n)]
        if not base.compiled:
            raise ValueError(f"{base.name} with latency={base.config.latency} has no correction")
        if base.name != card.base or not set(card.states) <= set(base_states) or base.dt != TICK:
            raise ValueError(
                f"the correction was trained on {card.base} with {', '.join(card.states)} and "
                f"ticks of {TICK:g} s; this is {base.name} with {', '.join(base_states)} and "
                f"ticks of {base.dt:g} s"
            )
        self.base, self.names, self.correction = base, base.names, correction
        self.net = make_net(correction, base.names)
        self.memory = np.zeros(compute_memory_size(self.net, len(base.names)))
        self.memory[kernel.MASS] = vehicle.mass
        self.reset(base.sensors, 0)

    def reset(self, sensors: Mapping[str, SlowSensor] | None, first: int) -> None:
        """Reset as `EstimatorLike.reset` does.

        Args:
            sensors: Slow sensors of this episode by name; None keeps the clocks of the last one.
            first: Tick of the first fast row.
        """
        self.base.reset(sensors, first)
        reset_memory(self.memory, first)

    def step(self, rows: Array, packets: Array) -> None:
        """Process fast rows and packets as `EstimatorLike.step` does.

        Args:
            rows: Fast rows, shape (k, FAST_WIDTH).
            packets: Packets, shape (count, PACKET_WIDTH).
        """
        record = rows, len(rows), packets.reshape(-1, PACKET_WIDTH), len(packets)
        _compile_step()(self.base.filters, self.base.gains, *record, self.memory, self.net)

    @property
    def x(self) -> Array:
        """The present states, shape (n,)."""
        x = self.base.x
        x[self.net.beta] += self.memory[kernel.SHIFT]
        return x

    @property
    def P(self) -> Array:
        """Their present covariance, shape (n, n)."""
        P, beta, deviation = self.base.P, self.net.beta, self.memory[kernel.DEVIATION]
        if deviation > 0.0:  # else there is no correction
            P[beta], P[:, beta], P[beta, beta] = 0.0, 0.0, deviation * deviation
        return P


@functools.cache
def _compile_step() -> Any:
    """Return `filter_and_correct` as a plain call."""
    record = np.zeros((1, 1)), 0, np.zeros((1, 1)), 0
    layers = np.zeros(1, FILTER), np.zeros((1, 1, 1))
    return compile_call(filter_and_correct, *layers, *record, np.zeros(1), EXAMPLE)


def learned(
    *,
    vehicle: Vehicle,
    sensors: Mapping[str, SlowSensor],
    dt: float = TICK,
    speed: float | None = None,
    file: str | Path | Correction = "joint",
    **options: Any,
) -> LearnedEstimator:
    """Build the filter that a correction was trained on, with that correction.

    It is an `EstimatorFactory`; errors are those of `load_correction` and `make_estimator`.

    Args:
        vehicle: The filter's vehicle.
        sensors: Slow sensors by name; the filter takes all, as in the training.
        dt: Tick (s).
        speed: Speed (m/s) if it is held; None measures it.
        file: Name of a shipped correction, path of a file, or a `Correction`.
        **options: Options of the filter, over those of the training.

    Returns:
        The estimator.
    """
    correction = file if isinstance(file, Correction) else load_correction(file)
    settings = {"slow": list(sensors)} | correction.card.base_options | options
    facts: dict[str, Any] = {"vehicle": vehicle, "sensors": sensors, "dt": dt, "speed": speed}
    base = make_estimator(correction.card.base, **facts, **settings)
    return LearnedEstimator(base, correction, vehicle)


learned_exact_kf = functools.partial(learned, file="exact-kf")
learned_joint = functools.partial(learned, file="joint")
