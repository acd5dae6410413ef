"""Sideslip estimators: filters for fast, slow and late sensors, and the door for your own.

`make_estimator` builds one by name; `EstimateObservation` puts it around an environment, and its
namesake in `vector` around all rows of a vector env. Both take a user's own estimator as well:
`EstimatorLike` is what that needs, `register_estimator` gives it a name.

Where to start reading: `filters` has the table of filters, one row each; `make` turns a row into an
`Estimator`: `design.config` parses its options, `design.assemble` writes its compiled record from
models, noise and schedules. `core.record` names every number of a filter, `core.filter` is what
happens at every tick. `wrappers` and `vector` put filters around environments; `protocol` and
`registry` are for users' own. `analysis` has the error bound, the smoother and `DualRate`.
May import `envs`; nothing of `agents` or `benchmarks`.
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
    "FILTERS",
    "DualRate",
    "EstimateObservation",
    "Estimates",
    "Estimator",
    "EstimatorFactory",
    "EstimatorLike",
    "FilterConfig",
    "FilterOptions",
    "UnobservableWarning",
    "make_estimator",
    "register_estimator",
    "smooth",
]
