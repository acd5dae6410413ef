"""A policy's network at one observation after another, compiled: frames, cells, dense layers.

Its arrays lie one behind the other in one vector, weights transposed, so that a layer's sums grow
input by input. Sums are in double precision and in one order, whatever the batch.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.backend.decorators import jit, jit_nrt
from ...envs.backend.elementary import clip, exp
from ...envs.backend.primitives import maximum, minimum
from ...envs.record import Array
from .memory import MemoryLayer

ACTIVATIONS = ("tanh", "relu", "elu", "leaky-relu", "silu")
OUTPUTS = ("tanh", "linear")
TANH, RELU, ELU, LEAKY, SILU = range(len(ACTIVATIONS))
_MAX_EXPONENT = 40.0  # where e^-x is nothing beside 1


class PackedNetwork(NamedTuple):
    """A network as compiled code takes it.

    Attributes:
        mean: Mean of a frame, or of the stack.
        scale: Scale of a frame, or of the stack.
        clip: Bound of normalised inputs, infinite for none.
        inputs: Number of entries of a frame.
        history: Number of frames.
        cells: `form` of each cell, shape (k, 4).
        sizes: Sizes of the dense layers, inputs first.
        activation: Place in `ACTIVATIONS`.
        output: Place in `OUTPUTS`.
        numbers: Numbers of each cell and layer in turn; a layer's are weights (inputs, outputs) row
            by row, then biases.
    """

    mean: Array
    scale: Array
    clip: float
    inputs: int
    history: int
    cells: npt.NDArray[np.int64]
    sizes: npt.NDArray[np.int64]
    activation: int
    output: int
    numbers: Array


def pack_network(
    scaling: tuple[Array, Array, float | None],
    history: int,
    cells: Sequence[MemoryLayer],
    layers: Sequence[tuple[Array, Array]],
    activation: str,
    output: str,
) -> PackedNetwork:
    """Pack a network for compiled code.

    Args:
        scaling: Mean, scale and clip.
        history: Number of frames.
        cells: Cells before the dense layers.
        layers: Weights (outputs, inputs) and biases (outputs,) of each dense layer.
        activation: Name of `ACTIVATIONS`.
        output: Name of `OUTPUTS`.

    Returns:
        The packed network.
    """
    mean, scale, max_abs = scaling
    first_weights = cells[0].weight_in if cells else layers[0][0]
    numbers = [cell.numbers for cell in cells]
    numbers += [part.T.ravel() for layer in layers for part in layer]
    return PackedNetwork(
        mean,
        scale,
        np.inf if max_abs is None else float(max_abs),
        first_weights.shape[1] // history,
        history,
        np.array([memory_layer.form for memory_layer in cells], np.int64).reshape(-1, 4),
        np.array([layers[0][0].shape[1], *(len(b) for _, b in layers)], np.int64),
        ACTIVATIONS.index(activation),
        OUTPUTS.index(output),
        np.concatenate(numbers),
    )


@jit
def _tanh(x: Any) -> Any:
    return 1.0 - 2.0 / (1.0 + exp(clip(x + x, 0.0 - _MAX_EXPONENT, _MAX_EXPONENT)))


@jit
def _sigmoid(x: Any) -> Any:
    return 1.0 / (1.0 + exp(clip(0.0 - x, 0.0 - _MAX_EXPONENT, _MAX_EXPONENT)))


@jit
def _apply_activation(x: Any, kind: int) -> Any:
    """Apply an activation with torch's default arguments."""
    if kind == TANH:
        return _tanh(x)
    if kind == RELU:
        return maximum(x, 0.0)
    if kind == LEAKY:
        return maximum(x, 0.01 * x)
    if kind == SILU:
        return x * _sigmoid(x)
    return x if x > 0.0 else exp(maximum(x, 0.0 - _MAX_EXPONENT)) - 1.0


@jit
def _apply_dense(z: Any, numbers: Any, offset: int, out: Any) -> int:
    """Write out = W z + b with the numbers at a place; return the place behind them."""
    n = len(out)
    bias = offset + len(z) * n
    for o in range(n):
        out[o] = numbers[bias + o]
    for i in range(len(z)):
        row, x = numbers[offset + i * n : offset + i * n + n], z[i]
        for o in range(n):
            out[o] += row[o] * x
    return bias + n


@jit_nrt
def _step_cell(z: Any, h: Any, gates: int, numbers: Any, offset: int) -> int:
    """Step torch's GRU (3 gates) or LSTM (4); h: its state, updated; return the place behind."""
    n = len(h) // (gates - 2)
    from_input, from_state = np.empty(gates * n), np.empty(gates * n)
    offset = _compute_gates(z, h[:n], numbers, offset, from_input, from_state)
    for i in range(n):
        if gates == 3:
            reset = _sigmoid(from_input[i] + from_state[i])
            update = _sigmoid(from_input[n + i] + from_state[n + i])
            candidate = _tanh(from_input[2 * n + i] + reset * from_state[2 * n + i])
            h[i] = (1.0 - update) * candidate + update * h[i]
        else:
            enter, forget, candidate, leave = (
                from_input[i] + from_state[i],
                from_input[n + i] + from_state[n + i],
                from_input[2 * n + i] + from_state[2 * n + i],
                from_input[3 * n + i] + from_state[3 * n + i],
            )
            h[n + i] = _sigmoid(forget) * h[n + i] + _sigmoid(enter) * _tanh(candidate)
            h[i] = _sigmoid(leave) * _tanh(h[n + i])
    return offset


@jit
def _compute_gates(
    z: Any, h: Any, numbers: Any, offset: int, from_input: Any, from_state: Any
) -> int:
    """Compute a cell's sums of input and state, whose arrays stand as in `CELL_WEIGHTS`."""
    n, n_inputs = len(from_input), len(z) + len(h)
    for o in range(n):
        from_input[o] = numbers[offset + n_inputs * n + o]
        from_state[o] = numbers[offset + (n_inputs + 1) * n + o]
    for i in range(n_inputs):
        row, target = (
            numbers[offset + i * n : offset + i * n + n],
            from_input if i < len(z) else from_state,
        )
        x = z[i] if i < len(z) else h[i - len(z)]
        for o in range(n):
            target[o] += row[o] * x
    return offset + (n_inputs + 2) * n


@jit_nrt
def _step_averages(z: Any, m: Any, form: Any, numbers: Any, offset: int) -> Any:
    """Step `MovingAverages`; return the output and the place behind.

    m: steps so far and means, updated.
    """
    units, times = form[1], form[3]
    out = np.empty(units * (1 + times))
    end = _apply_dense(z, numbers, offset + times, out[:units])
    for i in range(units - form[2], units):
        out[i] = _apply_activation(out[i], SILU)
    m[0] += 1.0
    for j in range(times):
        share = maximum(numbers[offset + j], 1.0 / m[0])
        for i in range(units):
            k = j * units + i
            m[1 + k] += share * (out[i] - m[1 + k])
            out[units + k] = m[1 + k]
    return out, end


@jit_nrt
def forward(net: Any, x: Any, state: Any, out: Any) -> None:
    """Compute the network's outputs.

    Args:
        net: `PackedNetwork`.
        x: Observations, shape (N, inputs).
        state: Memory of each row, shape (N, memory), updated.
        out: Output, shape (N, width).
    """
    k, stacked, last = net.inputs, net.inputs * net.history, len(net.sizes) - 1
    framewise, frames = len(net.mean) == k, stacked - k
    for row in range(len(x)):
        m, z = state[row], np.empty(stacked)
        z[:frames] = m[:frames]
        z[frames:] = x[row]
        for i in range(stacked):
            if i >= frames or not framewise:
                j = i - frames if framewise else i
                value = (z[i] - net.mean[j]) * net.scale[j]
                z[i] = minimum(maximum(value, 0.0 - net.clip), net.clip)
        if framewise:
            m[:frames] = z[k:]
        else:
            for i in range(frames):
                m[i] = m[i + k] if i + k < frames else x[row, i + k - frames]
        offset, position = 0, frames
        for c in range(len(net.cells)):
            gates, size = net.cells[c, 0], net.cells[c, 1]
            if gates == 0:
                n_state = 1 + size * net.cells[c, 3]
                z, offset = _step_averages(
                    z, m[position : position + n_state], net.cells[c], net.numbers, offset
                )
            else:
                n_state = size * (gates - 2)
                offset = _step_cell(z, m[position : position + n_state], gates, net.numbers, offset)
                z = m[position : position + size].copy()
            position += n_state
        for layer in range(last):
            y = np.empty(net.sizes[layer + 1])
            offset = _apply_dense(z, net.numbers, offset, y)
            kind = net.activation if layer < last - 1 else net.output
            if layer < last - 1 or net.output == TANH:
                for i in range(len(y)):
                    y[i] = _apply_activation(y[i], kind)
            z = y
        out[row] = z
