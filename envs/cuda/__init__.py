"""The engine as one CUDA kernel a step: `text` makes device functions of it, `kernel` is the fused
step, `ptx` its code without a GPU, `env` the environments."""
