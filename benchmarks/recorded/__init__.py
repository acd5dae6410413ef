"""Recorded drives: estimators scored where a log has the truth, and fits of the car that drove.

Args:
    logs: Parts of a recorded drive, at least one.
    car: Stated car.
    wires: Calibration of the steering.
    replay: Results of a log.
    path: File to write, whose ending may choose the format.
"""
