"""Standard test procedures: what is driven, what is measured, what passes; one module a standard.

A procedure drives a car through `drive.DriveFunction`, a function from a scenario's fields to the
time series of what the car did, so that the same code tests an environment of ours with any
controller and an outside plant. Criteria are pure functions of these series.
"""
