"""The estimates of a whole record, and the warning of what they cannot contain."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class UnobservableWarning(UserWarning):
    """A filter has a direction that its sensors cannot see."""


@dataclass(frozen=True)
class Estimates:
    """A filter's states at every row of a record.

    time: (K,) s. x, std: (K, n), states and standard deviations. names: of the n states. nis:
    (packets,), the normalised innovation squared of each; NaN where it was not used.
    """

    time: Array
    x: Array
    std: Array
    names: tuple[str, ...]
    nis: Array

    def __getitem__(self, name: str) -> Array:
        """One state by name, (K,)."""
        return self.x[:, self.names.index(name)]
