"""Networks by NumPy and in files, and a network's correction of a filter's sideslip angle.

`network` and `memory` are dense layers, cells and traces, `network_file` their safetensors;
policies are such files too. `files` has a correction with its card, `kernel` what happens at every
tick, `correction` the estimator, "learned-exact-kf" by name; the shipped files lie in
`corrections`.
"""
