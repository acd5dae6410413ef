"""The log density that a filter gives to each measurement before it takes it: its likelihood."""

import math

import numpy as np

from ...envs.numerics.jit import jit
from ...envs.numerics.primitives import Matrix, Vector
from ...envs.record import FAST, PACKET, Array, Log
from ..core.covariance import dot, project
from ..core.filter import run_tick
from ..core.innovation import BUFFER, MAX_SURPRISE, NONE
from ..core.packets import process_packet
from ..core.predict import compute_residual, read_fast_row
from ..core.record import FilterRecord, GainTables
from ..core.update import correct_fast
from ..estimator import Estimator


@jit
def _collect(
    f: FilterRecord,
    gains: GainTables,
    fast: Matrix,
    packets: Matrix,
    y: Vector,
    residuals: Matrix,
    S: Matrix,
    slow: Matrix,
) -> None:
    """Fill the fast rows' residuals (K, m) and covariances (K, m, m), the packets' NIS and log of
    the root of their determinant (count, 2)."""
    position = 0
    for j in range(len(fast)):
        read_fast_row(f, fast[j], 0.5 * (fast[j, FAST.wheel_left] + fast[j, FAST.wheel_right]))
        blocks, block_rows = f.blocks, f.block_rows
        for i in range(f.fasts):  # without them the tick only predicts
            y[i] = f.y[i]
            f.y[i] = np.nan
        run_tick(f, gains)
        f.blocks, f.block_rows = blocks, block_rows
        for i in range(f.fasts):
            f.y[i] = y[i]
        for i in range(f.fasts):
            residuals[j, i] = compute_residual(f, i)
            S[j, i, i] = project(f, f.C_fast[i]) + f.r_fast[i]
            for k in range(i + 1, f.fasts):
                S[j, k, i] = dot(f.C_fast[k], f.PC, f.n)
                S[j, i, k] = S[j, k, i]
        correct_fast(f, gains)
        while position < len(packets) and not packets[position, PACKET.arrived] > f.tick:
            process_packet(f, gains, packets[position])
            slow[position, 0] = f.nis
            for i in range(f.rows[int(packets[position, PACKET.sensor])]):
                slow[position, 1] += np.log(f.S[i, i])  # Cholesky's factor
            position += 1


def compute_log_densities(estimator: Estimator, log: Log) -> tuple[Array, Array, Array]:
    """Compute the log density of each fast row and packet, given all that came before it.

    A squared innovation counts up to `MAX_SURPRISE` variances; what is not used counts 0.

    Args:
        estimator: One with gains "covariance" that takes late samples by clones.
        log: Recorded drive.

    Returns:
        Log densities of fast rows, shape (rows,), and of packets, shape (count,), and residuals of
        the fast measurements before they correct, shape (rows, m).

    Raises:
        ValueError: The estimator has other gains, or another rule.
    """
    f = estimator.filters[0]
    is_plain = estimator.compiled and f.between == NONE and f.periodic == 0 and f.pace == 1
    if len(estimator.filters) > 1 or not is_plain or f.joint == 1 or f.late == BUFFER:
        raise ValueError(
            f"{estimator.name}: a likelihood needs one layer with gains='covariance' and "
            "delay='clone', and no latency of fast sensors"
        )
    record = estimator.prepare_record(log)
    fast, packets = (np.ascontiguousarray(a, np.float64) for a in (record.fast, record.packets))
    rows, m = len(fast), int(f.fasts)
    residuals, S, slow = np.zeros((rows, m)), np.zeros((rows, m, m)), np.zeros((len(packets), 2))
    slow[:, 0] = np.nan
    _collect(f, estimator.gains, fast, packets, np.zeros(m), residuals, S, slow)
    factor = np.linalg.cholesky(S)
    white = np.linalg.solve(factor, np.nan_to_num(residuals)[:, :, None])[:, :, 0]
    scale = np.log(np.diagonal(factor, axis1=1, axis2=2)) + 0.5 * math.log(2.0 * math.pi)
    by_row = -(0.5 * np.minimum(white**2, MAX_SURPRISE) + scale).sum(axis=1)
    values = np.asarray(f.rows)[packets[:, PACKET.sensor].astype(int)]
    by_packet = -0.5 * np.minimum(slow[:, 0], MAX_SURPRISE) - slow[:, 1]
    by_packet -= 0.5 * values * math.log(2.0 * math.pi)
    return by_row, np.nan_to_num(by_packet), residuals
