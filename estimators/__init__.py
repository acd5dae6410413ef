"""Sideslip estimators: filters for fast, slow and late sensors.

`make_estimator` builds one by name; `EstimateObservation` puts it around an environment.

Where to start reading: `papers` has the table of filters, `make` and `options` turn a row of it
into a filter, `models` says which states it has, `delay` and `intersample` are its rules. `core`
is what runs at every tick on a filter's `memory`; `covariance` and `periodic` give it its gains
from the textbook equations of `kalman`, `stability` refuses what diverges. `estimator` and
`wrappers` are the faces, `bound` the ceiling.
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
