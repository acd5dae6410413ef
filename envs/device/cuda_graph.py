"""The env-step as one launch: a CUDA graph of it, which spares the launches of its many kernels."""

from typing import Any

from ..backend.on_torch import torch
from .step import Outcome, State, Step

Tensor = torch.Tensor
_WARM = 3  # calls before the recording, as torch asks for


class Graphed:
    """A `Step` that is recorded at its first call and replayed from then on.

    The parameters and keys must stay the same tensors, whose numbers may change. What it returns
    is the caller's own.
    """

    def __init__(self, step: Step) -> None:
        self._step = step
        self._graph: torch.cuda.CUDAGraph | None = None
        self._fixed: tuple[Tensor, ...] = ()

    def __call__(
        self, p: Tensor, keys: Tensor, state: State, actions: Tensor
    ) -> tuple[State, Outcome]:
        """As `Step`."""
        fixed = (p, keys)
        if self._graph is None or any(a is not b for a, b in zip(fixed, self._fixed, strict=True)):
            self._record(p, keys, state, actions)
        assert self._graph is not None
        for mine, new in zip((*self._state, self._actions), (*state, actions), strict=True):
            mine.copy_(new)
        self._graph.replay()
        after, outcome = self._after
        copies = [each.clone() for each in (*after, *outcome)]
        return State(*copies[: len(after)]), Outcome(*copies[len(after) :])

    def _record(self, p: Tensor, keys: Tensor, state: State, actions: Tensor) -> None:
        self._fixed = (p, keys)
        self._state = State(*(each.clone() for each in state))
        self._actions = actions.clone()
        stream: Any = torch.cuda.Stream(p.device)  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream(p.device))
        with torch.cuda.stream(stream):
            for _ in range(_WARM):
                self._step(p, keys, self._state, self._actions)
        torch.cuda.current_stream(p.device).wait_stream(stream)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._after = self._step(p, keys, self._state, self._actions)
