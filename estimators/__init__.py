"""Sideslip estimators: filters for fast, slow and late sensors, and the door for your own.

`make_estimator` builds one by name; `EstimateObservation` puts it around an environment, and its
namesake in `vector` around all rows of a vector env. Both take a user's own estimator as well:
`EstimatorLike` is what that needs, `register_estimator` gives it a name.

Where things are: `filters` is the catalogue, one row a filter; `make` builds a row's filter with
`design` (options, models, gains) and returns an `Estimator`. `core` is what runs at every tick,
compiled, on a filter's memory. `wrappers` and `vector` put filters around environments. `protocol`
and `registry` are for users' own. `analysis` has the error bound, the smoother and `DualRate`.
May import `envs`; nothing of `agents` or `benchmarks`.
"""

from .analysis.linear_system import DualRate
from .analysis.smoother import smooth
from .estimates import Estimates, UnobservableWarning
from .estimator import Estimator
from .filters import FILTERS
from .make import make_estimator, register_estimator
from .protocol import EstimatorFactory, EstimatorLike
from .wrappers.estimate import EstimateObservation

__all__ = [
    "FILTERS",
    "DualRate",
    "EstimateObservation",
    "Estimates",
    "Estimator",
    "EstimatorFactory",
    "EstimatorLike",
    "UnobservableWarning",
    "make_estimator",
    "register_estimator",
    "smooth",
]
