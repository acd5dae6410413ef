"""One filter's memory: a single record that compiled code reads and writes in place.

A filter is its record, so a copy of the record is a complete snapshot and an array of records is
a batch. Sizes are fixed so that every filter runs on the same compiled code.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..envs.record import PACKET_WIDTH, SLOW_NAMES

CORE = 8  # room for the states of the model
INPUTS = 2  # delta_f, N_z
SLOW = len(SLOW_NAMES)
ROWS = 2  # measured combinations of one slow sensor
FRAMES = 8  # frames of one slow sensor under way at once
WIDTH = CORE + SLOW * FRAMES  # the states and their clones
SEEN = 16  # frames whose stamps are remembered, to know a duplicate
WAITING = 8  # packets that wait for the next step of a single-rate filter

Filters = npt.NDArray[Any]
"""(count,) of the dtype `FILTER`."""


class Counters(NamedTuple):
    """What a filter skipped, by reason."""

    refused: int = 0  # captured before the oldest state the filter still holds
    duplicates: int = 1  # same sensor and captured tick as an earlier packet
    future: int = 2  # captured or arriving after "now"
    invalid: int = 3  # not finite, in a packet or in a fast row
    poor: int = 4  # quality 0
    unknown: int = 5  # no sensor of ours, or a stamp off the sensor's clock


COUNTERS = Counters()

_INT, _FLOAT = np.int64, np.float64

FILTER = np.dtype(
    [
        # the model: dx = A x + B u on the first `dense` states, the rest decay by themselves
        ("n", _INT),  # states
        ("dense", _INT),
        ("total", _INT),  # states and clones
        ("forces", _INT),  # 1: disturbances are a force and a moment; 0: d_1, d_2 of (5)
        ("car", _FLOAT, (6,)),  # m, I, l_f, l_r, C_f, C_r
        ("preview", _FLOAT),
        ("moment_arm", _FLOAT),  # N_z = moment_arm (T_r - T_l)
        ("step", _FLOAT),  # s, the filter's own step
        ("A", _FLOAT, (CORE, CORE)),
        ("B", _FLOAT, (CORE, CORE)),  # inputs, then disturbances
        ("G", _FLOAT, (CORE, CORE)),  # tie-vision (9), rows of the dense states
        ("H", _FLOAT, (CORE, INPUTS)),
        ("decay", _FLOAT, (CORE,)),
        ("Q", _FLOAT, (CORE, CORE)),  # of one step
        # what is measured
        ("gyro", _FLOAT, (CORE,)),
        ("r_gyro", _FLOAT),
        ("rows", _INT, (SLOW,)),
        ("row", _FLOAT, (SLOW, ROWS, CORE)),
        ("angle", _INT, (SLOW, ROWS)),  # 1: the residual is wrapped
        ("r", _FLOAT, (SLOW, ROWS)),
        ("r_course", _FLOAT),  # (rad m/s)^2: the variance is r_course / V^2; 0: r as it stands
        # clocks in ticks
        ("stride", _INT),  # ticks of one step of the filter
        ("origin", _INT),  # phase of a single-rate filter's steps
        ("period", _INT, (SLOW,)),  # 0: not used
        ("phase", _INT, (SLOW,)),
        ("frames", _INT, (SLOW,)),  # clones are held for so many frames
        ("home", _INT, (SLOW,)),  # where they start
        ("ignore", _INT),  # 1: late samples are taken for fresh ones
        # gains
        ("periodic", _INT),
        ("pseudo", _INT),  # 1: pseudo-residuals between samples
        ("cycle", _INT),  # steps of the schedule's period
        ("pattern", _INT),  # frames in it
        ("low", _FLOAT),  # m/s, speed of the first table of gains
        ("high", _FLOAT),
        ("spacing", _FLOAT),  # m/s between tables; 0: one table
        # speed
        ("measured", _INT),  # 1: from the wheels, 0: fixed
        ("smoothing", _FLOAT),  # share of a new sample in the low-pass
        ("speed", _FLOAT),  # m/s, low-passed
        ("model_speed", _FLOAT),  # the present model's
        ("cell", _INT),  # the present table of gains
        ("wanted", _INT),  # the table that is missing; -1: none
        # the prior
        ("start", _INT),  # tick of the first row
        ("prior", _FLOAT, (CORE, CORE)),
        # now
        ("tick", _INT),  # of the last row
        ("begun", _INT),
        ("at", _INT),  # step within the schedule's period
        ("x", _FLOAT, (WIDTH,)),
        ("P", _FLOAT, (WIDTH, WIDTH)),
        ("e", _FLOAT, (WIDTH,)),  # estimated error, tie-vision (18)
        ("expected", _FLOAT, (ROWS,)),  # C x before this tick's corrections, slow rows
        ("eps", _FLOAT, (1 + ROWS,)),  # residuals used in this tick: gyro, slow rows
        ("ph", _FLOAT, (WIDTH,)),
        ("gain", _FLOAT, (WIDTH,)),  # of the last measurement
        ("work", _FLOAT, (3, CORE, CORE)),
        ("u", _FLOAT, (INPUTS,)),  # the last finite inputs
        ("u_sum", _FLOAT, (INPUTS,)),
        ("u_count", _INT),
        ("next", _INT, (SLOW,)),  # tick of the next capture
        ("stamp", _INT, (SLOW, FRAMES)),  # captured tick of each clone; -1: none waits
        ("seen", _INT, (SLOW, SEEN)),
        ("fixes", _INT),  # courses used so far
        ("waiting", _FLOAT, (WAITING, PACKET_WIDTH)),
        ("waits", _INT),
        ("cursor", _INT),  # packets of the present call that are done
        ("counts", _INT, (len(Counters._fields),)),
    ],
    align=True,
)
