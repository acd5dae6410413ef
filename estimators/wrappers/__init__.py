"""Observation wrappers: an estimator, or the truth, beside the observation of one environment."""

from .estimate import EstimateObservation as EstimateObservation
from .truth import TruthObservation as TruthObservation
