"""Sideslip estimators: filters for fast, slow and late sensors.

`make_estimator` builds one by name; `EstimateObservation` puts it around an environment.

Where to start reading: `papers` has the table of filters; `make` turns a row of it into one, asking
`options` and `wish` what the user wants and `rules` what that means in numbers. `models` and
`transition` say which states it has and how they move, `delay` and `intersample` are its rules.
`core` is what runs at every tick on a filter's `memory`: `step` predicts and takes the fast rows,
`arrivals` and `measure` the packets, `layers` tells a second layer. Gains come from `covariance` at
every step or, for a schedule that repeats, from `periodic`, `placed` and `spread`, in the textbook
equations of `kalman`; `stability` refuses what diverges. `estimator` and `wrappers` are the faces,
`dual_rate` that of any linear system, `smoother` tells the truth of a log offline, `bound` is the
ceiling.
"""

from .analysis.linear_system import DualRate
from .analysis.smoother import smooth
from .estimates import Estimates, UnobservableWarning
from .estimator import Estimator
from .filters import FILTERS
from .make import make_estimator
from .wrappers.estimate import EstimateObservation

__all__ = [
    "FILTERS",
    "DualRate",
    "EstimateObservation",
    "Estimates",
    "Estimator",
    "UnobservableWarning",
    "make_estimator",
    "smooth",
]
