"""Observations of vector environments: all rows' estimates in one compiled call, or the truth.

Args:
    env: Vector environment of N rows.
    rows: Numbers of some rows.
    mask: Rows at work, bool, shape (N,).
    specs: Vehicle, sensors and speed of each one's estimator.
    dt: Tick (s).
    source: Name or factory of the estimators.
    options: Their options.
    record: Records of N cars.
    observed: Observations and outputs of N cars.
    snapshot: Result of `get_state`.
    prefix: "" for the newest step, "final_" for that before a row's newest reset.
    label: Title of the estimates.
    beta: Estimates of the sideslip angle (rad), shape (N,).
    std: Their standard deviations (rad), shape (N,).
"""

from .estimate import EstimateObservation as EstimateObservation
from .estimate import TruthObservation as TruthObservation
