"""The environments on torch tensors: `torch_env` with gradients, `cuda_env` one CUDA kernel a step.

`base` is what both share. `torch_ticks`, `torch_outputs` and `torch_step` are the engine's step by
torch, `gradients` its derivatives. `cuda_text` makes device functions of the engine's own text,
`cuda_kernel` is the fused step, `cuda_launch` compiles it without a GPU and starts it.
"""

from .torch_env import DeviceVectorEnv

__all__ = ["DeviceVectorEnv"]
