"""Networks, evaluated with NumPy and stored in files; correction of a filter's sideslip angle.

`forward` has dense layers, cells and moving averages, `network` a whole network and its safetensors
file; policies are such files too. `correction` is the estimator "learned-exact-kf" and what it does
at every tick, `correction_file` its file with a card; the shipped ones lie in `corrections`.
"""
