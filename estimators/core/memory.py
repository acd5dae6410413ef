"""One filter's memory: a single record that compiled code reads and writes in place.

A filter is its record, so a copy of the record is a complete snapshot and an array of records is
a batch. Sizes are fixed so that every filter runs on the same compiled code.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.record import PACKET_WIDTH
from ...envs.sensors.slow import SLOW_NAMES

CORE = 8  # room for the states of the model
INPUTS = 4  # that drive it
FASTS = 2  # measurements of a fast row
SLOW = len(SLOW_NAMES)
ROWS = 4  # measured combinations of one slow sensor
FRAMES = 8  # frames of one slow sensor under way at once
WIDTH = 32  # the states and their clones
SEEN = 16  # frames whose stamps are remembered, to know a duplicate
WAITING = 8  # packets that wait for the next step of a single-rate filter
KNOTS = 8  # of the table of HDOP
WINDOW = 512  # ticks that can be told again (rules "stored", "constant", "buffer")
EVERY = 16  # ticks between two snapshots of the rule "buffer"
SNAPSHOTS = WINDOW // EVERY
RECENT = 64  # packets within the window

Filters = npt.NDArray[Any]
"""(count,) of the dtype `FILTER`."""


class Counters(NamedTuple):
    """What a filter skipped, by reason."""

    refused: int = 0  # captured before the oldest state the filter still holds
    duplicates: int = 1  # same sensor and captured tick as an earlier packet
    future: int = 2  # captured or arriving after "now"
    invalid: int = 3  # not finite (or beyond all measure), in a packet or in a fast row
    poor: int = 4  # quality 0, or too few satellites
    unknown: int = 5  # no sensor of ours, or a stamp that is no tick of the sensor's clock
    gated: int = 6  # an innovation that chi-square calls impossible


COUNTERS = Counters()

_INT, _FLOAT = np.int64, np.float64

FILTER = np.dtype(
    [
        # the model: dx = A x + B u on the first `dense` states, the rest decay by themselves
        ("kind", _INT),  # of `transition`
        ("n", _INT),  # states
        ("dense", _INT),
        ("delayed", _INT),  # the last dense states that lag behind what the camera sees
        ("total", _INT),  # states and clones
        ("forces", _INT),  # 1: disturbances are a force and a moment; 0: they push states
        ("pushed", _INT, (CORE,)),  # the state that each disturbance pushes
        ("car", _FLOAT, (6,)),  # m, I, l_f, l_r, C_f, C_r
        ("roll", _FLOAT, (3,)),  # K_x / I_x, C_x / I_x, M_s h_s / I_x
        ("preview", _FLOAT),
        ("step", _FLOAT),  # s, the filter's own step
        ("relax", _FLOAT),  # share by which the delayed states follow in a step
        ("A", _FLOAT, (CORE, CORE)),
        ("B", _FLOAT, (CORE, INPUTS + CORE)),  # inputs, then disturbances
        ("G", _FLOAT, (CORE, CORE)),  # tie-vision (9), rows of the dense states
        ("H", _FLOAT, (CORE, INPUTS)),
        ("drift", _FLOAT, (CORE,)),  # known part of a step, dual-rate (7) u_d
        ("decay", _FLOAT, (CORE,)),
        ("Q", _FLOAT, (CORE, CORE)),  # of one step
        # inputs and fast measurements: sums of two columns of the fast row
        ("inputs", _INT),
        ("u_column", _INT, (INPUTS, 2)),
        ("u_factor", _FLOAT, (INPUTS, 2)),
        ("fasts", _INT),
        ("y_column", _INT, (FASTS, 2)),
        ("y_factor", _FLOAT, (FASTS, 2)),
        ("y_row", _FLOAT, (FASTS, CORE)),
        ("y_feed", _FLOAT, (FASTS, INPUTS)),
        ("r_fast", _FLOAT, (FASTS,)),
        # what the slow sensors measure
        ("rows", _INT, (SLOW,)),
        ("row", _FLOAT, (SLOW, ROWS, CORE)),
        ("angle", _INT, (SLOW, ROWS)),  # 1: the residual is wrapped
        ("r", _FLOAT, (SLOW, ROWS)),
        ("r_course", _FLOAT),  # (rad m/s)^2: the variance is r_course / V^2; 0: r as it stands
        ("r_speed", _FLOAT),  # (m/s)^2, of the GPS's speed; what a second layer is told
        ("knots", _INT),  # of the table HDOP -> factor on the GPS's noise; 0: none
        ("hdop", _FLOAT, (KNOTS,)),
        ("hdop_factor", _FLOAT, (KNOTS,)),
        ("satellites", _FLOAT),  # GPS packets with fewer are refused
        ("gate", _FLOAT, (ROWS + 1,)),  # by dimension, the largest NIS; 0: no gate
        ("adapt", _FLOAT),  # share of a new innovation in the scale of R; 0: R as told
        # clocks in ticks
        ("stride", _INT),  # ticks of one step of the filter
        ("pace", _INT),  # ticks between two steps that listen to sensors
        ("origin", _INT),  # phase of a single-rate filter's steps
        ("period", _INT, (SLOW,)),  # 0: not used
        ("phase", _INT, (SLOW,)),
        ("frames", _INT, (SLOW,)),  # frames that are held until they arrive
        ("home", _INT, (SLOW,)),  # where their clones start
        ("late", _INT),  # of `delay.RULES`
        ("trailing", _INT),  # 1: predicted states are kept
        ("assumed", _INT),  # ticks that the rule "constant" takes every sample to be late
        # gains
        ("periodic", _INT),
        ("joint", _INT),  # 1: the rows of a sensor correct together, not one after the other
        ("between", _INT),  # of `intersample.BETWEEN`
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
        ("turning", _FLOAT),  # rad/s, the yaw rate that kinematic models are told
        ("cell", _INT),  # the present table of gains
        ("wanted", _INT),  # the table that is missing; -1: none
        # the prior
        ("start", _INT),  # tick of the first row
        ("prior", _FLOAT, (CORE, CORE)),
        ("speed_state", _INT),  # the state that starts at the measured speed; -1: none
        # now
        ("tick", _INT),  # of the last row
        ("begun", _INT),
        ("at", _INT),  # step within the schedule's period
        ("x", _FLOAT, (WIDTH,)),
        ("P", _FLOAT, (WIDTH, WIDTH)),
        ("u", _FLOAT, (INPUTS,)),  # the last finite inputs
        ("u_sum", _FLOAT, (INPUTS,)),
        ("u_count", _INT),
        ("y", _FLOAT, (FASTS,)),  # of this tick; NaN: none
        ("next", _INT, (SLOW,)),  # tick of the next capture
        ("stamp", _INT, (SLOW, FRAMES)),  # captured tick of each frame held; -1: none waits
        ("r_before", _FLOAT),  # variance of the course at the row before
        ("r_held", _FLOAT, (FRAMES,)),  # variance of the course in each frame held of the GPS
        ("seen", _INT, (SLOW, SEEN)),
        ("first_fix", _INT),  # captured tick of the first course used; -1: none yet
        ("sample", _FLOAT, (PACKET_WIDTH,)),  # the packet at hand
        ("waiting", _FLOAT, (WAITING, PACKET_WIDTH)),
        ("waits", _INT),
        ("cursor", _INT),  # packets of the present call that are done
        ("counts", _INT, (len(Counters._fields),)),
        ("scale", _FLOAT, (SLOW, ROWS)),  # of R, where it adapts
        ("nis", _FLOAT),  # of the last packet; NaN where it is not known
        # pseudo-residuals
        ("share", _FLOAT, (FASTS + ROWS, WIDTH)),  # gain of each tick, where it is no table
        ("inverse", _FLOAT, (FASTS + ROWS, WIDTH)),  # transposed, likewise
        ("e", _FLOAT, (WIDTH,)),  # estimated error, tie-vision (18)
        ("expected", _FLOAT, (ROWS,)),  # C x before this tick's corrections, slow rows
        ("eps", _FLOAT, (FASTS + ROWS,)),  # residuals used in this tick: fast, slow rows
        ("since", _INT),  # steps since the last sample; -1: none yet
        # Larsen: what the residual of a sample under way will do to the states, and to what
        ("promise", _FLOAT, (SLOW, ROWS, CORE)),
        ("promised", _FLOAT, (SLOW, ROWS)),
        # scratch
        ("ph", _FLOAT, (WIDTH,)),
        ("gain", _FLOAT, (WIDTH,)),  # of the last measurement
        ("residual", _FLOAT, (ROWS,)),
        ("S", _FLOAT, (ROWS, ROWS)),
        ("FP", _FLOAT, (CORE, WIDTH)),
        ("work", _FLOAT, (3, CORE, INPUTS + CORE)),
        # what happened in the window
        ("trail", _FLOAT, (WINDOW, CORE)),  # predicted states
        ("told_u", _FLOAT, (WINDOW, INPUTS)),
        ("told_y", _FLOAT, (WINDOW, FASTS)),
        ("told_speed", _FLOAT, (WINDOW, 2)),  # the model's speed, the yaw rate it was told
        ("shot_x", _FLOAT, (SNAPSHOTS + 1, CORE)),  # the last is "now", while the past is told
        ("shot_P", _FLOAT, (SNAPSHOTS + 1, CORE, CORE)),
        ("recent", _FLOAT, (RECENT, PACKET_WIDTH)),
        ("recent_r", _FLOAT, (RECENT, ROWS)),  # variances as they were told with each of them
        ("lost", _INT),  # captured tick of the newest packet that is no longer kept
        ("replay", _INT, (RECENT,)),  # those that are told again
    ],
    align=True,
)
