"""A fixed-lag smoother around any filter with a covariance: what a log tells afterwards.

Each packet is used at the tick at which it was captured. The filter goes forwards block by block;
Rauch, Tung and Striebel's recursion then comes backwards from the end of the *next* block, so
that every estimate knows at least one lag of its future, and at most two.
"""

import copy
import math
from typing import Any, NamedTuple

import numpy as np

from ...envs.numerics.jit import jit
from ...envs.numerics.primitives import Matrix, Vector
from ...envs.record import PACKET, Array, Log
from ..core.filter import run_tick
from ..core.late_samples import IGNORE
from ..core.memory import GAIN, WINDOW, FilterMemory, GainTables
from ..core.model import BETA
from ..core.packets import process_packet
from ..core.predict import read_fast_row
from ..design.periodic import count_ticks
from ..estimator import Estimator
from ..make import make_estimator
from ..protocol import Estimates, compute_std

_RANK = 1e-14  # of a correlation matrix, what counts as nothing


def smooth(
    estimator: Estimator | str, log: Log, lag_seconds: float = 1.0, **options: Any
) -> Estimates:
    """Compute every state of a log given what was measured up to `lag_seconds` later, or longer.

    Source: Rauch, Tung and Striebel, AIAA J. 3 (1965) 1445. ValueError stands for what
    `Estimator.run` refuses, a lag that is not positive, and a filter that is no single Kalman
    filter: two layers, precomputed gains, corrections between samples; TypeError for one that is
    built and has options, or has no `filters` to smooth.

    Args:
        estimator: One with gains "covariance" that listens at every tick, whatever its rule for
            late samples, or the name of one, to be built for the log's sensors and columns; for
            another car than the COMS `vehicle` is among the options.
        log: Recorded drive.
        lag_seconds: Lag (s), whole ticks; a tick of block i (blocks of this length) has what was
            captured before block i + 2. `math.inf` takes the whole log.
        **options: Options of `make_estimator` for a name.

    Returns:
        States, standard deviations, and the NIS of each packet used at its capture.
    """
    if isinstance(estimator, str):
        defaults: dict[str, Any] = {"sensors": log.slow, "dt": log.record.dt, "gains": "covariance"}
        defaults["present"] = log.record.present
        estimator = make_estimator(estimator, **(defaults | options))
    elif options:
        raise TypeError(f"{estimator.name} is built, got {', '.join(options)}")
    if not (isinstance(estimator, Estimator) and estimator.compiled):
        text = "the smoother needs a filter of the catalogue without latency"
        raise TypeError(f"{text}, got {estimator!r}")
    if not lag_seconds > 0.0:
        raise ValueError(f"the lag is in s and positive, got {lag_seconds!r}")
    undelayed = _remove_delay(estimator)
    record = undelayed.prepare_record(log)
    rows = lag = len(record.fast)
    if math.isfinite(lag_seconds):
        lag = min(rows, count_ticks(lag_seconds, undelayed.dt, "the lag"))
    packets = np.array(record.packets, np.float64)
    packets[:, PACKET.arrived] = packets[:, PACKET.captured]
    by_capture = packets[:, PACKET.sensor], packets[:, PACKET.captured]
    order = np.lexsort((record.packets[:, PACKET.arrived], *by_capture))
    x, std, nis = _smooth_blocks(undelayed, np.ascontiguousarray(record.fast), packets[order], lag)
    ordered_nis = np.empty_like(nis)
    ordered_nis[order] = nis
    return Estimates(np.asarray(record.ticks * record.dt), x, std, undelayed.names, ordered_nis)


def _remove_delay(estimator: Estimator) -> Estimator:
    """Copy the filter for samples that are never late; ValueError where there is none."""
    f = estimator.filters[0]
    is_plain = f.gain_rule == GAIN.covariance and f.delayed == 0 and f.pace == 1
    if len(estimator.filters) > 1 or not is_plain:
        raise ValueError(
            f"{estimator.name}: a smoother needs one layer with gains='covariance', samples used "
            "when they come and no states that lag"
        )
    undelayed = copy.copy(estimator)
    undelayed.filters = estimator.filters.copy()
    f = undelayed.filters[0]
    f.delay_rule, f.total, f.stored = IGNORE, f.n, f.n
    f.frames[:] = 0
    return undelayed


class _FilteredBlock(NamedTuple):
    """Filtered rows."""

    F: Matrix  # transition from the row before, shape (K, n, n)
    before: Matrix  # prediction, shape (K, n)
    x: Matrix  # state after the row's samples, shape (K, n)
    P: Matrix  # its covariance, shape (K, n, n)
    Q: Matrix  # of the step to the row, shape (K, n, n)


@jit
def _filter_forwards(
    f: FilterMemory, gains: GainTables, fast: Matrix, packets: Matrix, position: int, nis: Vector,
    block: _FilteredBlock,
) -> int:  # fmt: skip
    """Filter fast rows, and packets from `position` on that arrive by then; return those done."""
    n, dense = f.n, f.dense
    F, before, x, P, Q = block
    for j in range(len(fast)):
        read_fast_row(f, fast[j])
        run_tick(f, gains)
        for i in range(n):
            before[j, i] = f.predicted[f.tick % WINDOW, i]
            for k in range(n):
                Q[j, i, k] = f.Q[i, k]
                diagonal = f.decay[i] if i == k else 0.0
                F[j, i, k] = f.G[i, k] if i < dense else diagonal
            if f.planar > 0 and f.speed_before > 0.0:
                F[j, i, BETA] *= f.speed_before / f.model_speed
        while position < len(packets) and not packets[position, PACKET.arrived] > f.tick:
            process_packet(f, gains, packets[position])
            nis[position] = f.nis
            position += 1
        for i in range(n):
            x[j, i] = f.x[i]
            for k in range(n):
                P[j, i, k] = f.P[i, k]
    return position


def _smooth_blocks(filter_: Estimator, fast: Array, packets: Array, lag: int) -> tuple[Array, ...]:
    """Compute smoothed states and standard deviations of all rows, and the packets' NIS."""
    f, gains, rows, n = filter_.filters[0], filter_.gains, len(fast), len(filter_.names)
    X, S, nis = np.empty((rows, n)), np.empty((rows, n)), np.full(len(packets), np.nan)
    span = min(2 * lag, rows)  # two blocks side by side
    blocks = [np.empty((span, n, *more)) for more in ((n,), (), (), (n,), (n,))]
    done = position = 0  # rows, packets
    for start in range(0, rows, lag):
        for array in blocks if start > 0 else ():  # what was the next block is the present one
            array[: span - lag] = array[lag:]
        first, end = done - start, min(start + span, rows)
        block = _FilteredBlock(*(array[first : end - start] for array in blocks))
        position = _filter_forwards(f, gains, fast[done:end], packets, position, nis, block)
        done = end
        x, std = _smooth_backwards(_FilteredBlock(*(array[: end - start] for array in blocks)))
        stop = min(start + lag, rows)
        X[start:stop], S[start:stop] = x[: stop - start], std[: stop - start]
    return X, S, nis


def _smooth_backwards(block: _FilteredBlock) -> tuple[Array, Array]:
    """Smooth by Rauch, Tung and Striebel from the last filtered state to the first."""
    F, before, x, P, Q = block
    predicted = F[1:] @ P[:-1] @ F[1:].transpose(0, 2, 1) + Q[1:]
    sd = np.sqrt(np.einsum("kii->ki", predicted))
    sd[sd == 0.0] = 1.0
    scaled = predicted / (sd[:, :, None] * sd[:, None, :])
    # singular where a state is known exactly
    inverse = np.linalg.pinv(scaled, _RANK, hermitian=True)
    J = P[:-1] @ F[1:].transpose(0, 2, 1) / sd[:, None, :] @ inverse / sd[:, None, :]
    x, P = x.copy(), P.copy()
    for k in range(len(J) - 1, -1, -1):
        x[k] += J[k] @ (x[k + 1] - before[k + 1])
        P[k] += J[k] @ (P[k + 1] - predicted[k]) @ J[k].T
    return x, compute_std(P)
