"""The estimates of a whole record, and the warning of what they cannot contain."""

from dataclasses import dataclass

from ..envs.record import Array


class UnobservableWarning(UserWarning):
    """A filter has a direction that its sensors cannot see."""


@dataclass(frozen=True)
class Estimates:
    """A filter's states at every row of a record.

    Attributes:
        time: Time (s), shape (K,).
        x: States, shape (K, n).
        std: Their standard deviations, shape (K, n).
        names: Names of the n states.
        nis: Normalised innovation squared of each packet, shape (packets,); NaN where it is not
            used.
    """

    time: Array
    x: Array
    std: Array
    names: tuple[str, ...]
    nis: Array

    def __getitem__(self, name: str) -> Array:
        """Return one state by name, shape (K,)."""
        return self.x[:, self.names.index(name)]
