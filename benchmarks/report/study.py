"""What the suites of a question share: rows of their numbers, and figures where plotly is."""

from collections.abc import Mapping
from importlib import import_module
from types import ModuleType

from ... import __version__
from ..harness.results import ResultRow, Suite
from ..harness.stats import Estimate


def add_rows(
    suite: Suite, numbers: Mapping[str, Estimate], env_id: str = "", **columns: str | int
) -> None:
    """Add a row of each number of a scenario, on fixed seeds unless `salt` says otherwise.

    Args:
        suite: Suite to which the rows are added.
        numbers: Numbers with their intervals by metric.
        env_id: Id of the env, "" where rows have the package's version alone.
        **columns: Other columns of `ResultRow`, which all rows share.
    """
    common = {"salt": "fixed", "env_version": f"{env_id} {__version__}".lstrip()} | columns
    for metric, number in numbers.items():
        suite.rows.append(ResultRow.from_estimate(metric, number, suite=suite.name, **common))


def import_figures() -> ModuleType | None:
    """Import the functions that draw, `report.figures`; None where plotly is not installed."""
    try:
        return import_module(".figures", __package__)
    except ModuleNotFoundError:
        return None
