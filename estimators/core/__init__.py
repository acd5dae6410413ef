"""A filter at every tick, compiled; it knows no sensor and no filter by name.

`memory` names every number of a filter, `filter` takes rows and packets. `predict` reads a row and
predicts, with `model` as the transition; `packets` judges what arrives, `update` corrects by it.
`late_samples` and `intersample` are the rules for samples that come late and for the time between
them. `covariance` and `innovation` have the Kalman filter's equations.

Args:
    f: Memory of a filter, or a block of lanes where a function takes one.
    gains: Tables of gains, shape (cells, rows, columns).
    layers: Memory of an estimator: (1,), or (2,), of which the second measures the first's states.
    record: Rows and packets to process.
    start: Number of its rows that are done already.
    outputs: Arrays to fill.
    observed: Observation and outputs.
    s: Index of a slow sensor.
    i: Index of a row of its measurement, or of a fast measurement.
    row: Row of C, shape (n,).
    frame: Place of a frame in the schedule, or f.pattern for between samples.
    captured: Captured tick of a sample.
    target: What a sample measures: its first clone, or a code of `late_samples`.
    is_gated: Whether the gate judges a sample and its NIS is taken: not once more when rewound.
    k: Row of the present table of gains.
    residual: Measurement minus its prediction.
    fast_row: Fast row, shape (FAST_WIDTH,).
    packet: Packet, shape (PACKET_WIDTH,).
    first: Tick of the first fast row.
    last: Tick of the filter's previous step.
    n: Number of states.
    v: Vector of states, shape (n,) or longer.
    variance: Variance of a residual; of a state what is added to it.
    state: Index of a state.
    speed: Speed (m/s).
    V: Speed of the model (m/s).
    model_speed: Speed of the model (m/s).
    turning: Yaw rate (rad/s).
    turn: Angle (rad) by which a heading turns.
    steer: Steering angle (rad).
    u: Inputs of a step, shape (N_INPUTS,).
"""
