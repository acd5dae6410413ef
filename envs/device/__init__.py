"""The device engine: the environments of an id as tensors; it needs torch.

The engine as one CUDA kernel a step: `text` makes device functions of it, `kernel` is the fused
step, `ptx` its code without a GPU, `env` the environments.
"""

from .torch_env import DeviceVectorEnv

__all__ = ["DeviceVectorEnv"]
