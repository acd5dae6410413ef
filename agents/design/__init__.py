"""What controllers are designed from: the sampled car, PI gains, gain schedules, the QP of MPC."""
