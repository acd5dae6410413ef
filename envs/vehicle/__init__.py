"""The car: parameters, equations of motion, tyres, actuators and its linear models.

`parameters.Vehicle` is what users write; `dynamics`, `tyres` and `actuators` are the plant,
functions of numbers alone. It imports `numerics`.
"""
