"""The matrix of estimators and controllers: cells, seeds, episodes, scores, tables, calibration."""
