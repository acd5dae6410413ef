"""How numba is made to compile kernels: its front end, each kernel's machine code, their files."""
