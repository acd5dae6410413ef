"""A filter at every tick, compiled: prediction, update, late samples, rules between samples.

`record` names every number of a filter, `filter` takes rows and packets. It knows no gymnasium, no
sensor and no filter by name: `design` writes the numbers that it runs on.

A tick: `predict` reads the row, predicts and corrects by the fast sensors, with `model` as the
transition; `packets` judges what arrives and finds the state it belongs to, `update` corrects by
it. `covariance` and `innovation` have the Kalman filter's equations.
"""
