"""Observations of vector environments: all rows' estimates in one compiled call, or the truth."""

from .estimate import EstimateObservation as EstimateObservation
from .estimate import TruthObservation as TruthObservation
