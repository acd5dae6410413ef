"""The matrix: estimators with controllers on manoeuvres, everyone on the same seeds."""
