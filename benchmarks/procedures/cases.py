"""The suite's cases and their results."""

from dataclasses import dataclass
from typing import Any

from . import fmvss126, iso7401
from .drive import Series

NAME = "procedures"


@dataclass(frozen=True)
class Case:
    """A drive: a procedure, a car or outside model, a contestant's index, seeds."""

    procedure: str
    car: str
    contestant: int = 0
    seeds: tuple[int, ...] = ()
    quick: bool = False


@dataclass(frozen=True)
class Sine:
    """FMVSS 126 of a contestant, and one of its runs to look at."""

    result: fmvss126.Result
    shown: Series


@dataclass(frozen=True)
class Transient:
    """ISO 7401 of a car: by output, measured and of the linear model."""

    step: dict[str, iso7401.StepResponse]
    linear_step: dict[str, iso7401.StepResponse]
    sweep: dict[str, iso7401.FrequencyResponse]
    linear_sweep: dict[str, Any]


Done = dict[Case, Any]
"""The result of every case."""


def of(done: Done, procedure: str) -> Done:
    """The cases of one procedure."""
    return {case: found for case, found in done.items() if case.procedure == procedure}
