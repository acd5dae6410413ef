"""Sideslip estimators: filters for fast, slow and late sensors.

`make_estimator` builds one by name; `EstimateObservation` puts it around an environment.
"""

from .estimates import Estimates, UnobservableWarning
from .estimator import Estimator
from .make import make_estimator
from .papers import FILTERS
from .wrappers import EstimateObservation

__all__ = [
    "FILTERS",
    "EstimateObservation",
    "Estimates",
    "Estimator",
    "UnobservableWarning",
    "make_estimator",
]
