"""The compiler and the kinds of numbers: one text for Python, SIMD lanes, NumPy, torch and CasADi.

`jit` compiles a plain function and rebuilds its text for another kind of numbers. Such texts may
call what `primitives`, `packed` and `functions` have. `simd` has the lanes, `torch_backend`
torch's tensors. `compiler` and `kernel_cache` keep machine code on disk.
"""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def require_extra(name: str, needs: str) -> Iterator[None]:
    """Require an extra around imports: ModuleNotFoundError names it where a package is missing.

    Args:
        name: Name of the extra.
        needs: Message, "pictures need pygame"; {} stands for the missing module's name.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        text = f"{needs.format(error.name)}: pip install 'sideslip[{name}]'"
        raise ModuleNotFoundError(text, name=error.name) from None
