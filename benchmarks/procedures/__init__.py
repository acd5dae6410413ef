"""Standard test procedures: what is driven, what is measured, what passes.

A procedure drives a car through `drive.DriveFunction`, whether that is an environment of ours with
any controller or an outside plant; criteria are pure functions of the time series.
"""
