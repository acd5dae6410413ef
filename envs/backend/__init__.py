"""The compiler and the kinds of numbers: one text for Python, SIMD lanes, NumPy, torch and CasADi.

`jit` compiles a plain function, `plain` rebuilds its text for another kind of numbers. `primitives`
and `arrays` are what such texts may call; `elementary` and `random` are built from them. Nothing of
sideslip is imported here, and every other room may import this one.
"""

from .arrays import at as at
from .arrays import lane_count as lane_count
from .arrays import offsets as offsets
from .arrays import put as put
from .arrays import ramp as ramp
from .arrays import read as read
from .arrays import write as write
from .cache import source_stamp as source_stamp
from .decorators import apart as apart
from .decorators import config as config
from .decorators import copied as copied
from .decorators import inlined as inlined
from .decorators import jit as jit
from .decorators import plain as plain
from .primitives import ARRAYS as ARRAYS
from .primitives import absolute as absolute
from .primitives import anywhere as anywhere
from .primitives import floor as floor
from .primitives import maximum as maximum
from .primitives import minimum as minimum
from .primitives import select as select
from .primitives import sqrt as sqrt
from .primitives import to_float as to_float
from .primitives import whole as whole
