"""Models and gains for controllers: the nominal and the sampled car, schedules, predictions."""
