"""Standard test procedures: what is driven, what is measured, what passes.

A procedure drives a car through `drive.DriveFunction`, whether that is an environment of ours with
any controller or an outside plant; criteria are pure functions of the time series.

Args:
    drive: Function that drives a car through a scenario.
    car: Car under test, one of `CARS` or an outside model, with speed and steering ratio.
    seed: Seed of what errs in car and sensors; None: nothing errs.
"""
