"""A filter at every tick, compiled; it knows no sensor and no filter by name.

`record` names every number of a filter, `filter` takes rows and packets. `predict` reads a row and
predicts, with `model` as the transition; `packets` judges what arrives, `update` corrects by it.
`covariance` and `innovation` have the Kalman filter's equations.
"""
