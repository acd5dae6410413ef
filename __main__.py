"""The command line: `sideslip` and `python -m sideslip`."""

import os

# read when SciPy is loaded: for matrices of 24 rows further threads only wait
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from .benchmarks.cli.main import main

__all__ = ["main"]

if __name__ == "__main__":
    main()
