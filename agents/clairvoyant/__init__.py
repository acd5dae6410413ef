"""The ceiling: plans that know the car, the road and every disturbance ahead."""
