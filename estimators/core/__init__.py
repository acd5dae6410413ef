"""A filter at every tick, compiled: prediction, update, late samples, rules between samples.

`memory` names every number of a filter, `run` takes rows and packets.
It knows no gymnasium, no sensor and no filter by name: `design` writes the numbers that it runs on.

A tick: `fast` reads the row, predicts and corrects by the fast sensors, with `transition` as the
model and `speed` saying when it changes; `packets` judges what arrives, `delay` or `rewind` finds
the state it belongs to, `update` corrects by it. `covariance` and `innovation` have the Kalman
filter's equations, `intersample` the rules between samples, `tyres` those that are estimated, and
`layers` what several records do together: double-layer's second one, and a bank.
"""
