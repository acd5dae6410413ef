"""The same for vector environments: all rows' estimators in one compiled call."""

from .estimate import EstimateObservation as EstimateObservation
from .truth import TruthObservation as TruthObservation
