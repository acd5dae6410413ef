"""One env-step on packed numbers: layout, reset, tick, step, outputs; batch and lanes.

`layout` names every number of a packed car, `config` packs a scenario into them, `tick` is one
millisecond, `step` one env-step of one car, `outputs` its packets and observation, `batch` the step
of many cars, side by side in SIMD registers.
"""
