"""An estimator that always estimates the same, and remembers what it was given."""

from typing import Any

import numpy as np


class Constant:
    """beta, gamma and friction, as `value` has it; `calls` of `reset` and `step`."""

    names: Any = ("mu", "gamma", "beta")

    def __init__(self, value: Any = (0.8, 0.2, 0.1), **arguments: Any) -> None:
        self.value, self.arguments, self.calls = value, arguments, list[Any]()

    @property
    def x(self) -> Any:
        return self.value

    @property
    def P(self) -> Any:
        return np.diag([0.04, 0.01, 0.0001])

    def reset(self, sensors: Any, first: int) -> None:
        self.calls = [("reset", sensors, first)]

    def step(self, rows: Any, packets: Any) -> None:
        self.calls.append((rows, packets))
