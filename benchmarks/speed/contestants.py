"""The contestants of one comparison, and those that could not come; what they took, shown."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from ..harness.results import Row, Suite, Table
from .timing import Contestant, Taken, spread


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


def absences(absent: Mapping[str, str]) -> str:
    """A sentence on those that could not come, or nothing."""
    if not absent:
        return ""
    return f" Not measured: {'; '.join(f'{name} ({why})' for name, why in absent.items())}."


def add_rows(suite: Suite, name: str, taken: Taken, unit: str) -> None:
    """CPU and wall time as rows; unit: "step" or "tick"."""
    for values, metric in ((taken.cpu, f"us_per_{unit}"), (taken.wall, f"wall_us_per_{unit}")):
        middle, low, high = spread(values)
        suite.rows.append(Row(suite.name, name, metric, middle, low=low, high=high, n=len(values)))


def add_costs(
    suite: Suite,
    title: str,
    unit: str,
    taken: Mapping[str, Taken],
    note: str,
    absent: Mapping[str, str],
) -> None:
    """A row and a table's line for each contestant."""
    cells = []
    for name, each in taken.items():
        add_rows(suite, name, each, unit)
        middle, low, high = spread(each.cpu)
        cells.append(
            [
                name,
                three(middle),
                f"{three(low)} .. {three(high)}",
                rate(middle),
                rate(spread(each.wall)[0]),
            ]
        )
    suite.tables.append(
        Table(
            title,
            ("", f"us per {unit}", "range", "per CPU-s", "per s"),
            cells,
            note + absences(absent),
            keyed=False,
        )
    )


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
