"""The environments on torch tensors: `torch_env` with gradients, `cuda_env` one CUDA kernel a step.

`base` is what both share. `torch_sensors` and `torch_step` are the engine's step by torch,
`cuda_kernel` is the fused step, made of the engine's own text.
"""

from typing import Any

import gymnasium as gym

from ..validation import check_choice
from .base import TensorVectorEnv
from .torch_env import DeviceVectorEnv

__all__ = ["DeviceVectorEnv", "TensorVectorEnv", "make_device_env"]


def make_device_env(
    env_id: str, num_envs: int = 1, engine: str = "torch", **arguments: Any
) -> TensorVectorEnv:
    """Make the environments of an id on a device.

    ValueError for an unknown engine, an id without such an env, `compile` or `grad` with "cuda".

    Args:
        env_id: Id that Gymnasium has registered.
        num_envs: Number of environments.
        engine: "torch" for a `DeviceVectorEnv` (with gradients), "cuda" for a `CudaVectorEnv`.
        arguments: Arguments of that class, which replace those of the id.
    """
    check_choice("engine", engine, ("torch", "cuda"))
    spec = gym.spec(env_id)
    if spec.vector_entry_point != "sideslip.envs.vector:StabilityVectorEnv":
        raise ValueError(f"{env_id} has no environment on the device")
    if engine == "torch":
        return DeviceVectorEnv(num_envs, **{**spec.kwargs, **arguments})
    if unsupported := [name for name in ("compile", "grad") if arguments.pop(name, False)]:
        raise ValueError(f"{unsupported[0]} is of engine='torch', not of 'cuda'")
    from .cuda_env import CudaVectorEnv

    return CudaVectorEnv(num_envs, **{**spec.kwargs, **arguments})
