"""What all tests share."""

import os

# Before numpy comes: on small matrices BLAS's threads only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from hypothesis import settings

# The first example of a property pays for compilation; the same examples come every time.
settings.register_profile("sideslip", deadline=None, derandomize=True)
settings.load_profile("sideslip")
