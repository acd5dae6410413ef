"""A filter at every tick, compiled: prediction, update, late samples, rules between samples.

`memory` names every number of a filter, `run` takes rows and packets, `entry` is what Python calls.
It knows no gymnasium and no names of filters: `design` writes the numbers that it runs on.
"""
