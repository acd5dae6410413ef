"""The car: parameters, equations of motion, tyres, actuators and its linear models.

`parameters.Vehicle` is what users write; `dynamics`, `tyres` and `actuators` are the plant, scalar
functions that are compiled; `linear` has the models for design.
"""
