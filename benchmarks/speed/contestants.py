"""The contestants of one comparison, those that could not come, and the table of their costs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from ..harness.results import Row, Suite, Table
from .timing import Contestant, Effort, Taken, interleaved, spread


class AbsentError(Exception):
    """A contestant that cannot come; the message says why."""


@dataclass
class Field:
    """Contestants by name; `absent`: why others are not among them."""

    contestants: dict[str, Contestant] = field(default_factory=dict)
    absent: dict[str, str] = field(default_factory=dict)

    def add(self, name: str, make: Callable[[], Contestant], package: str | None = None) -> None:
        """Make a contestant; without the optional package that it comes from it is absent."""
        try:
            self.contestants[name] = make()
        except AbsentError as error:
            self.absent[name] = str(error)
        except ModuleNotFoundError:
            if package is None:
                raise
            self.absent[name] = f"{package} is not installed"

    def measure(
        self, suite: Suite, title: str, unit: str, effort: Effort, note: str
    ) -> tuple[dict[str, Taken], dict[str, str]]:
        """Time the contestants, add rows and a table; (times by name, why others are absent).

        unit: "step" or "tick".
        """
        taken, cells = interleaved(self.contestants, effort), []
        for name, values in taken.items():
            middle, *ends = add_row(suite, name, f"us_per_{unit}", values)
            cells.append([name, three(middle), " .. ".join(map(three, ends)), rate(middle)])
        if cells:
            header = ("", f"us per {unit}", "range", "per CPU-s")
            text = note + absences(self.absent)
            suite.tables.append(Table(title, header, cells, text, keyed=False))
        return taken, self.absent


def add_row(suite: Suite, name: str, metric: str, values: Taken) -> tuple[float, float, float]:
    """Add a row of a suite; its (median, least, largest)."""
    middle, low, high = spread(values)
    suite.rows.append(Row(suite.name, name, metric, middle, low=low, high=high, n=len(values)))
    return middle, low, high


def absences(absent: Mapping[str, str]) -> str:
    """A sentence on those that could not come, or nothing."""
    if not absent:
        return ""
    return f" Not measured: {'; '.join(f'{name} ({why})' for name, why in absent.items())}."


def three(value: float) -> str:
    """A number to three digits, without an exponent.

    >>> three(0.04431), three(7.2), three(1004.0)
    ('0.0443', '7.2', '1000')
    """
    return f"{float(f'{value:.3g}'):g}"


def rate(microseconds: float) -> str:
    """How many in a second, to three digits.

    >>> rate(0.0443), rate(7.25), rate(1210.0)
    ('22,600,000', '138,000', '826')
    """
    return f"{float(f'{1e6 / microseconds:.3g}'):,.0f}"
