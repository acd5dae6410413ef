"""The device engine: the environments of an id as tensors; it needs torch."""

from .env import DeviceVectorEnv

__all__ = ["DeviceVectorEnv"]
