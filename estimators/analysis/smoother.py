"""A fixed-lag smoother around any filter with a covariance: what a log tells afterwards.

Offline every packet is there, so each is used at the tick at which it was captured. The filter goes
forwards block by block; Rauch, Tung and Striebel's recursion then comes backwards from the end of
the *next* block, so that every estimate knows at least one lag of its future, and at most two.
"""

import copy
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.backend.decorators import jit
from ...envs.record import FAST, PACKET, Log
from ..core.delay import IGNORE
from ..core.fast import read
from ..core.intersample import NONE
from ..core.memory import WINDOW, Gains, Memory, Row
from ..core.packets import receive
from ..core.run import tick
from ..core.transition import BETA, LATERAL
from ..design.schedule import whole_ticks
from ..estimates import Estimates
from ..estimator import Estimator
from ..make import make_estimator

Array = npt.NDArray[np.float64]

_RANK = 1e-14  # of a correlation matrix, what counts as nothing


def smooth(
    estimator: Estimator | str, log: Log, lag_seconds: float = 1.0, **options: Any
) -> Estimates:
    """Every state of a log given what was measured up to `lag_seconds` later, or longer.

    estimator: one with gains "covariance" that listens at every tick, whatever its rule for late
    samples, or the name of one, to be built for the log's sensors with `options` as in
    `make_estimator`. lag_seconds: whole ticks; a tick of block i (blocks of this length) knows what
    was captured before block i + 2; `math.inf` for the whole log. Returns states and standard
    deviations, and the NIS of each packet used at its capture.

    Raises ValueError as `run`, for a lag that is none, and for a filter that is more, or less, than
    one Kalman filter: two layers, precomputed gains, corrections between samples.
    Source: Rauch, Tung and Striebel, AIAA J. 3 (1965) 1445.
    """
    if isinstance(estimator, str):
        usual: dict[str, Any] = {"sensors": log.slow, "dt": log.record.dt, "gains": "covariance"}
        estimator = make_estimator(estimator, **(usual | options))
    elif options:
        raise TypeError(f"{estimator.name} is built, got {', '.join(options)}")
    if not (isinstance(estimator, Estimator) and estimator.compiled):
        raise TypeError(
            f"the smoother needs a filter of the catalogue without latency, got {estimator!r}"
        )
    if not lag_seconds > 0.0:
        raise ValueError(f"the lag is in s and positive, got {lag_seconds!r}")
    prompt = _without_delay(estimator)
    record = prompt.accept(log)
    rows = len(record.fast)
    lag = rows
    if math.isfinite(lag_seconds):
        lag = min(rows, whole_ticks(lag_seconds, prompt.dt, "the lag"))
    packets = np.array(record.packets, np.float64)
    packets[:, PACKET.arrived] = packets[:, PACKET.captured]
    by = (record.packets[:, PACKET.arrived], packets[:, PACKET.sensor], packets[:, PACKET.captured])
    order = np.lexsort(by)
    x, std, nis = _blocks(prompt, np.ascontiguousarray(record.fast), packets[order], lag)
    found = np.empty_like(nis)
    found[order] = nis
    return Estimates(np.asarray(record.ticks * record.dt), x, std, prompt.names, found)


def _without_delay(estimator: Estimator) -> Estimator:
    """A copy of the filter for samples that are never late; ValueError where there is none."""
    f = estimator.filters[0]
    plain = f.between == NONE and f.periodic == 0 and f.delayed == 0 and f.pace == 1
    if len(estimator.filters) > 1 or not plain:
        raise ValueError(
            f"{estimator.name}: a smoother needs one layer with gains='covariance', samples used "
            "when they come and no states that lag"
        )
    prompt = copy.copy(estimator)
    prompt.filters = estimator.filters.copy()
    f = prompt.filters[0]
    f.late, f.total, f.store_predictions = IGNORE, f.n, 1
    f.frames[:] = 0
    return prompt


@jit
def _forwards(
    f: Memory,
    gains: Gains,
    fast: Any,
    packets: Any,
    at: int,
    nis: Row,
    F: Any,
    before: Any,
    x: Any,
    P: Any,
) -> int:
    """Filter fast rows (K, FAST_WIDTH) and the packets (count, PACKET_WIDTH) from `at` on that
    arrive by their end; returns the packets done.

    nis (count,): of the packets used. F (K, n, n): each row's transition from the one before.
    before (K, n): its prediction. x (K, n), P (K, n, n): after its samples.
    """
    n, dense = f.n, f.dense
    for j in range(len(fast)):
        read(f, fast[j], 0.5 * (fast[j, FAST.wheel_left] + fast[j, FAST.wheel_right]))
        tick(f, gains)
        for i in range(n):
            before[j, i] = f.predicted[f.tick % WINDOW, i]
            for k in range(n):
                same = f.decay[i] if i == k else 0.0
                F[j, i, k] = f.G[i, k] if i < dense else same
            if f.kind == LATERAL and f.speed_before > 0.0:
                F[j, i, BETA] *= f.speed_before / f.model_speed
        while at < len(packets) and not packets[at, PACKET.arrived] > f.tick:
            receive(f, gains, packets[at])
            nis[at] = f.nis
            at += 1
        for i in range(n):
            x[j, i] = f.x[i]
            for k in range(n):
                P[j, i, k] = f.P[i, k]
    return at


def _blocks(prompt: Estimator, fast: Array, packets: Array, lag: int) -> tuple[Array, Array, Array]:
    """Smoothed states and standard deviations of all rows, and the packets' NIS."""
    f, rows, n = prompt.filters[0], len(fast), len(prompt.names)
    Q = np.array(f.Q[:n, :n])
    X, S, nis = np.empty((rows, n)), np.empty((rows, n)), np.full(len(packets), np.nan)
    span = min(2 * lag, rows)
    # F, before, x, P of two blocks, as `_forwards` fills them
    both = np.empty((span, n, n)), np.empty((span, n)), np.empty((span, n)), np.empty((span, n, n))
    done = at = 0  # rows, packets
    for start in range(0, rows, lag):
        for array in both if start > 0 else ():  # what was the next block is the present one
            array[: span - lag] = array[lag:]
        first = done - start
        end = min(start + span, rows)
        views = (array[first : end - start] for array in both)
        at = _forwards(f, prompt.gains, fast[done:end], packets, at, nis, *views)
        done = end
        x, std = _backwards(Q, *(array[: end - start] for array in both))
        stop = min(start + lag, rows)
        X[start:stop], S[start:stop] = x[: stop - start], std[: stop - start]
    return X, S, nis


def _backwards(Q: Array, F: Array, before: Array, x: Array, P: Array) -> tuple[Array, Array]:
    """Rauch, Tung and Striebel: from the last filtered state to the first."""
    predicted = F[1:] @ P[:-1] @ F[1:].transpose(0, 2, 1) + Q
    sd = np.sqrt(np.einsum("kii->ki", predicted))
    sd[sd == 0.0] = 1.0
    scaled = predicted / (sd[:, :, None] * sd[:, None, :])
    known = np.linalg.pinv(scaled, _RANK, hermitian=True)  # singular where a state is known exactly
    J = P[:-1] @ F[1:].transpose(0, 2, 1) / sd[:, None, :] @ known / sd[:, None, :]
    x, P = x.copy(), P.copy()
    for k in range(len(J) - 1, -1, -1):
        x[k] += J[k] @ (x[k + 1] - before[k + 1])
        P[k] += J[k] @ (P[k + 1] - predicted[k]) @ J[k].T
    return x, np.sqrt(np.maximum(np.einsum("kii->ki", P), 0.0))
