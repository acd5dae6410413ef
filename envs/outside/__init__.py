"""CommonRoad's single-track, drift and multi-body models behind our sensors, tasks and env."""
