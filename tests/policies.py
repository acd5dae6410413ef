"""Policies of an older tree as files: one of the sensors alone, with a GRU, and with averages."""

from pathlib import Path

_OLD = Path(__file__).parent / "files/old"
VISION, GRU, TRACES = (
    str(_OLD / f"{name}.safetensors") for name in ("ppo-yaw-vision", "raw-car-yaw", "raw-coms-yaw")
)
