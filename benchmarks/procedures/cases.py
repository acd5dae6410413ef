"""The suite's cases and their results."""

from dataclasses import dataclass
from typing import Any

from . import fmvss126, iso7401
from .drive import Series

NAME = "procedures"


@dataclass(frozen=True)
class ProcedureCase:
    """A drive: a procedure, a car or outside model, a contestant's index, seeds."""

    procedure: str
    car: str
    contestant: int = 0
    seeds: tuple[int, ...] = ()
    quick: bool = False


@dataclass(frozen=True)
class SineDwellOutcome:
    """FMVSS 126 of a contestant, and one of its runs to look at."""

    result: fmvss126.SineDwellResult
    shown: Series


@dataclass(frozen=True)
class Transient:
    """ISO 7401 of a car: by output, measured and of the linear model."""

    step: dict[str, iso7401.StepResponse]
    linear_step: dict[str, iso7401.StepResponse]
    sweep: dict[str, iso7401.FrequencyResponse]
    linear_sweep: dict[str, Any]


CaseResults = dict[ProcedureCase, Any]
"""The result of every case."""


def select_cases(done: CaseResults, procedure: str) -> CaseResults:
    """The cases of one procedure."""
    return {case: result for case, result in done.items() if case.procedure == procedure}
