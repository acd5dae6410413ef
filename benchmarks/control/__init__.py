"""The matrix of estimators and controllers: tasks, entries, runs, scores, tables, calibration."""
