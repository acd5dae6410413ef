"""Sideslip estimators: filters for fast, slow and late sensors, and the door for your own.

Where to start reading: `filters` has the table of filters; `make` turns a row into an `Estimator`:
`design.config` parses its options, `design.assemble` writes its memory. `core.memory` names every
number of a filter, `core.filter` is what happens at every tick. `wrappers` and `vector` put filters
around environments, `joint` one around a user's signals. `protocol` is for users' own.
"""

from .analysis.linear_system import DualRate
from .analysis.smoother import smooth
from .design.options import FilterConfig, FilterOptions
from .estimator import Estimator
from .filters import FILTERS
from .make import make_estimator, register_estimator
from .protocol import Estimates, EstimatorFactory, EstimatorLike, UnobservableWarning
from .wrappers.estimate import EstimateObservation

__all__ = [
    "FILTERS", "DualRate", "EstimateObservation", "Estimates", "Estimator", "EstimatorFactory",
    "EstimatorLike", "FilterConfig", "FilterOptions", "UnobservableWarning", "make_estimator",
    "register_estimator", "smooth",
]  # fmt: skip
