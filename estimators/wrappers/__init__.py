"""Observation wrappers: an estimator, or the truth, beside the observation of one environment.

Args:
    seed: Seed of the env, or None.
    options: Options of the env's reset, or None.
    action: Action of the env.
    snapshot: Result of `get_state`.
    estimator: The estimator at work.
    vehicle: True vehicle, with its stiffnesses (N/rad).
"""

from .estimate import EstimateObservation as EstimateObservation
from .truth import TruthObservation as TruthObservation
