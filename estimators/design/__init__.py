"""From a filter's name and options to its numbers: models, noise, gains, schedules, checks.

The offline half of a filter, in NumPy: what `make_estimator` calls before the first tick.

Args:
    config: Parsed options of a filter.
    vehicle: The filter's vehicle.
    f: Memory of a filter, left as it is.
    schedule: Schedule of its slow sensor.
    dt: Tick (s).
    speed: Speed (m/s) that is held; None where it is measured.
    F: Transition matrix of a step, shape (n, n).
    G: Transition of the dense states, shape (dense, n).
    C: Measurement matrix, shape (p, n).
    P: Covariance of the state, shape (n, n).
    R: Covariance of the measurement noise, shape (p, p).
    K: Gain, shape (n, p).
    shares: B_i of a dual-rate rule, shape (steps, n, p).
"""
