"""The car: parameters, equations of motion, tyres, actuators and its linear models.

`parameters.Vehicle` is what users write; `dynamics`, `tyres` and `actuators` are the plant,
functions of numbers alone. It imports `numerics`.

Args:
    car: Parameters of the car, `CarParams`, or the six of `Bicycle`.
    motion: `Motion` of the car, or its `Velocity`.
    road: `RoadParams`.
    s: Distance along the road (m).
    load: `TyreLoad` of the inputs; of a step those at its start, middle and end.
    disturbance: `DisturbanceForces`.
    variant: `PlantVariant`, or what has its fields.
    small_angle: 1 for the small-angle plant, else 0.
    g_y: Lateral gravity that the car feels on a banked road (m/s2).
    h: Length of a step (s).
    v_x: Longitudinal velocity (m/s).
    v_y: Lateral velocity (m/s).
    V: Speed (m/s).
    T_l: Torque of the left motor (N m).
    T_r: Torque of the right motor (N m).
    vehicle: Vehicle of a model.
"""
