"""A policy's network at one observation after another, compiled: frames, cells, dense layers.

Its arrays lie one behind the other in one vector, weights transposed, so that a layer's sums grow
input by input. Sums are in double precision and in one order, whatever the batch.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.backend.decorators import counted, jit
from ...envs.backend.elementary import clip, exp
from ...envs.backend.primitives import maximum, minimum
from .memory import Array, Memory

ACTIVATIONS = ("tanh", "relu", "elu", "leaky-relu", "silu")
OUTPUTS = ("tanh", "linear")
TANH, RELU, ELU, LEAKY, SILU = range(len(ACTIVATIONS))
_LARGE = 40.0  # where e^-x is nothing beside 1


class Packed(NamedTuple):
    """A network as compiled code takes it.

    mean, scale: of a frame, or of the stack. clip: infinite for none. inputs: of a frame. history:
    frames. cells: (k, 4) the form of each. sizes: of the dense layers, inputs first. activation,
    output: places in their tuples. numbers: of each cell and layer in turn; a layer's are weights
    (inputs, outputs) row by row, then biases.
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


def packed(
    scaling: tuple[Array, Array, float | None],
    history: int,
    cells: Sequence[Memory],
    layers: Sequence[tuple[Array, Array]],
    activation: str,
    output: str,
) -> Packed:
    """scaling: mean, scale and clip. layers: weights (outputs, inputs) and biases of each."""
    mean, scale, most = scaling
    first = cells[0].weight_in if cells else layers[0][0]
    numbers = [cell.numbers for cell in cells]
    numbers += [part.T.ravel() for layer in layers for part in layer]
    return Packed(
        mean,
        scale,
        np.inf if most is None else float(most),
        first.shape[1] // history,
        history,
        np.array([each.form for each in cells], np.int64).reshape(-1, 4),
        np.array([layers[0][0].shape[1], *(len(b) for _, b in layers)], np.int64),
        ACTIVATIONS.index(activation),
        OUTPUTS.index(output),
        np.concatenate(numbers),
    )


@jit
def _tanh(x: Any) -> Any:
    return 1.0 - 2.0 / (1.0 + exp(clip(x + x, 0.0 - _LARGE, _LARGE)))


@jit
def _sigmoid(x: Any) -> Any:
    return 1.0 / (1.0 + exp(clip(0.0 - x, 0.0 - _LARGE, _LARGE)))


@jit
def _bent(x: Any, kind: int) -> Any:
    """An activation with torch's default arguments."""
    if kind == TANH:
        return _tanh(x)
    if kind == RELU:
        return maximum(x, 0.0)
    if kind == LEAKY:
        return maximum(x, 0.01 * x)
    if kind == SILU:
        return x * _sigmoid(x)
    return x if x > 0.0 else exp(maximum(x, 0.0 - _LARGE)) - 1.0


@jit
def _sums(z: Any, numbers: Any, at: int, out: Any) -> int:
    """out = W z + b with the numbers at a place; the place behind them."""
    n = len(out)
    bias = at + len(z) * n
    for o in range(n):
        out[o] = numbers[bias + o]
    for i in range(len(z)):
        row, x = numbers[at + i * n : at + i * n + n], z[i]
        for o in range(n):
            out[o] += row[o] * x
    return bias + n


@counted
def _cell(z: Any, h: Any, gates: int, numbers: Any, at: int) -> int:
    """A step of torch's GRU (3 gates) or LSTM (4); h: its state, updated; the place behind."""
    n = len(h) // (gates - 2)
    taken, held = np.empty(gates * n), np.empty(gates * n)
    at = _in_turn(z, h[:n], numbers, at, taken, held)
    for i in range(n):
        if gates == 3:
            reset = _sigmoid(taken[i] + held[i])
            update = _sigmoid(taken[n + i] + held[n + i])
            candidate = _tanh(taken[2 * n + i] + reset * held[2 * n + i])
            h[i] = (1.0 - update) * candidate + update * h[i]
        else:
            enter, forget, candidate, leave = (
                taken[i] + held[i],
                taken[n + i] + held[n + i],
                taken[2 * n + i] + held[2 * n + i],
                taken[3 * n + i] + held[3 * n + i],
            )
            h[n + i] = _sigmoid(forget) * h[n + i] + _sigmoid(enter) * _tanh(candidate)
            h[i] = _sigmoid(leave) * _tanh(h[n + i])
    return at


@jit
def _in_turn(z: Any, h: Any, numbers: Any, at: int, taken: Any, held: Any) -> int:
    """What a cell takes of its input and of its state, whose arrays stand as in `PARTS`."""
    n, wide = len(taken), len(z) + len(h)
    for o in range(n):
        taken[o] = numbers[at + wide * n + o]
        held[o] = numbers[at + (wide + 1) * n + o]
    for i in range(wide):
        row, into = numbers[at + i * n : at + i * n + n], taken if i < len(z) else held
        x = z[i] if i < len(z) else h[i - len(z)]
        for o in range(n):
            into[o] += row[o] * x
    return at + (wide + 2) * n


@counted
def _traced(z: Any, m: Any, form: Any, numbers: Any, at: int) -> Any:
    """(a step of `Traces`, the place behind); m: steps so far and means, updated."""
    units, times = form[1], form[3]
    out = np.empty(units * (1 + times))
    end = _sums(z, numbers, at + times, out[:units])
    for i in range(units - form[2], units):
        out[i] = _bent(out[i], SILU)
    m[0] += 1.0
    for j in range(times):
        share = maximum(numbers[at + j], 1.0 / m[0])
        for i in range(units):
            k = j * units + i
            m[1 + k] += share * (out[i] - m[1 + k])
            out[units + k] = m[1 + k]
    return out, end


@counted
def forward(net: Any, x: Any, state: Any, out: Any) -> None:
    """out (N, width) of observations x (N, inputs); state (N, memory) is updated."""
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
        number, at = 0, frames
        for c in range(len(net.cells)):
            gates, size = net.cells[c, 0], net.cells[c, 1]
            if gates == 0:
                wide = 1 + size * net.cells[c, 3]
                z, number = _traced(z, m[at : at + wide], net.cells[c], net.numbers, number)
            else:
                wide = size * (gates - 2)
                number = _cell(z, m[at : at + wide], gates, net.numbers, number)
                z = m[at : at + size].copy()
            at += wide
        for layer in range(last):
            y = np.empty(net.sizes[layer + 1])
            number = _sums(z, net.numbers, number, y)
            kind = net.activation if layer < last - 1 else net.output
            if layer < last - 1 or net.output == TANH:
                for i in range(len(y)):
                    y[i] = _bent(y[i], kind)
            z = y
        out[row] = z
