"""One env-step on packed numbers: layout, reset, tick, step, packets, observation; batch and lanes.

`layout` names every number of a packed car, `tick` is one millisecond, `step` one env-step of one
car, `batch` of many, `lanes` of those that are computed side by side in SIMD registers.
"""
