"""One filter's memory: named numbers that compiled code reads and writes in place.

A copy is a complete snapshot. Sizes are fixed, so every filter runs on the same compiled code; the
codes `delay_rule` and `gain_rule` say which fields are used.
`design.assemble` writes what options and vehicle decide, `reset_filters` and the ticks the rest.

What a model lacks takes no branch: its coefficients are 0 and its state stands at SPARE. Rows and
columns of that place in A, B, C and Q are written as all others are, and lie behind those in use.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.numerics.packed import make_offsets, pad_to_cache_line
from ...envs.record import PACKET_WIDTH
from ...envs.sensors.slow import SLOW_NAMES
from ...envs.vehicle.linear import Bicycle

N_CORE = 24  # states of a model; in whole eights, as `N_TOTAL`
SPARE = N_CORE - 2  # the place, with the one behind it, of states that a model lacks
N_INPUTS = 4  # inputs that drive a model
N_FAST = 3  # measurements of a fast row
N_DRIVERS = N_CORE + 8  # columns of B: inputs, then disturbances
N_SLOW = len(SLOW_NAMES)  # slow sensors
N_ROWS = 4  # rows of C of one slow sensor
N_FRAMES = 8  # frames of one slow sensor that are captured and have not arrived
N_TOTAL = 32  # states and their clones
N_STAMPS = 16  # frames whose stamps are stored, to know a duplicate
N_WAITING = 8  # packets that wait for the next step of a single-rate filter
N_KNOTS = 8  # knots of the table of HDOP
WINDOW = 512  # ticks of history (rules "stored", "constant", "buffer")
SNAPSHOT_INTERVAL = 16  # ticks between two snapshots of the rule "buffer"
N_SNAPSHOTS = WINDOW // SNAPSHOT_INTERVAL
N_RECENT = 64  # packets within the window

FilterMemory = Any  # an entry of the dtype `FILTER`; `f` in all compiled code
FilterLayers = npt.NDArray[Any]  # (layers,) or (filters, layers) of the dtype `FILTER`
GainTables = Any  # (cells of speed, rows, columns), see `design.periodic`; ones where P gives them


class SkipCounters(NamedTuple):
    """Places in the field `counts`, which counts what a filter skipped, by reason."""

    refused: int = 0  # captured before the oldest state the filter still has
    duplicates: int = 1  # same sensor and captured tick as an earlier packet
    future: int = 2  # captured or arriving after "now"
    invalid: int = 3  # not finite or beyond all measure, in a packet or a fast row
    poor: int = 4  # quality 0, or too few satellites
    unknown: int = 5  # no sensor of the filter, or a stamp that is no tick of the sensor's clock
    gated: int = 6  # an innovation that chi-square calls impossible
    stuck: int = 7  # every value as in the sensor's last packet, of an earlier tick, while it moves


class GainRules(NamedTuple):
    """Codes of the field `gain_rule`: where gains come from, what corrects between samples.

    The order counts: up to `split` P is there, up to `joint` a tick's residuals come at once.
    """

    covariance: int = 0  # from P, one measurement after the other; nothing between samples
    split: int = 1  # likewise; a sample's gain is split over its period, by pseudo-residuals
    pseudo: int = 2  # a constant gain from a table, for all residuals of a tick, pseudo-ones too
    joint: int = 3  # from a table, for all fast residuals of a tick; nothing between samples
    table: int = 4  # from a table, one measurement after the other; nothing between samples
    dual_rate: int = 5  # likewise, and fractions of the last innovation between samples


COUNTERS, GAIN = SkipCounters(), GainRules()
CAR, CAR_WIDTH = make_offsets(Bicycle)  # places in `car`

_INT, _FLOAT = np.int64, np.float64

_FIELDS: list[tuple[Any, ...]] = [
    # model: dx = A x + B u on the first `dense` states; those behind them decay by themselves
    ("n", _INT),  # states
    ("dense", _INT),
    ("delayed", _INT),  # the last dense states that lag behind what the camera sees
    ("total", _INT),  # states and clones
    ("first_bias", _INT),  # the first state that nothing drives but noise
    ("planar", _INT),  # of beta, gamma, psi, y_l those that a bicycle has; 0: no bicycle
    # beta' by the first disturbance d: (push_rate + push_force / (M V)) d
    ("push_rate", _FLOAT),
    ("push_force", _FLOAT),
    ("bank_state", _INT),  # the road's bank
    ("steer_offset_state", _INT),
    ("offset_share", _FLOAT),  # 1: the measured steering angle has the offset in it
    ("map_heading_state", _INT),  # error of the map's heading
    ("curved_state", _INT),  # y_l where sin(course) is not taken for the course
    ("map_lag", _FLOAT),  # s, deviation of the time by which the road's curvature is late
    ("phi_state", _INT),  # a bicycle's phi, followed by phi_rate
    ("car", _FLOAT, (CAR_WIDTH,)),
    ("roll_stiffness", _FLOAT),  # K_x / I_x
    ("roll_damping", _FLOAT),  # C_x / I_x
    ("roll_arm", _FLOAT),  # M_s h_s / I_x; 0: it does not roll
    ("sway", _FLOAT),  # m, M_s h_s / M
    ("preview", _FLOAT),  # m
    # tyres that are estimated: `car` has their slopes by slip at the present state
    ("tyre_states", _INT),  # factors of front and rear stiffness, then 1/friction; 0: known tyres
    ("tyres", _INT),  # where they begin
    ("tyre", _FLOAT, (3,)),  # what they are; without 1/friction that is 0, tyres without a limit
    ("stiffness", _FLOAT, (2,)),  # N/rad, nominal, of the axles
    ("load", _FLOAT, (2,)),  # N, on the axles
    ("force_slopes", _FLOAT, (2, 2)),  # N, of each axle's force: by its factor, by 1/friction
    ("rest", _FLOAT, (2,)),  # N, force of each axle that its linear terms leave over
    ("linearise_every", _INT),  # ticks after which the tyres' forces are expanded again
    ("q_tyres", _FLOAT, (3,)),  # variances of a step of factors and 1/friction, while it moves
    ("model_error", _FLOAT),  # fraction of the axles' forces by which the tyres' law errs
    ("q_nominal", _FLOAT, (2,)),  # variances of a step of F_d, N_d without `model_error`
    ("q_share", _FLOAT, (2,)),  # fractions of their variances that come in a step
    ("step", _FLOAT),  # s, the filter's own step
    ("relax", _FLOAT),  # fraction by which the delayed states follow in a step
    ("A", _FLOAT, (N_CORE, N_CORE)),  # `build_model` writes what speed and yaw rate change
    ("B", _FLOAT, (N_CORE, N_DRIVERS)),  # inputs, then disturbances
    ("push", _FLOAT, (N_CORE,)),  # what `rest` adds to dx
    ("G", _FLOAT, (N_CORE, N_CORE)),  # tie-vision (9), rows of the dense states
    ("H", _FLOAT, (N_CORE, N_INPUTS)),
    ("drift", _FLOAT, (N_CORE,)),  # known part of a step, of tyres
    ("decay", _FLOAT, (N_CORE,)),  # fraction of a state that is left after a step
    ("GT", _FLOAT, (N_CORE, N_CORE)),  # G and H transposed; zeros beyond the dense states
    ("HT", _FLOAT, (N_INPUTS, N_CORE)),
    ("own_decay", _FLOAT, (N_TOTAL,)),  # F = diag(own_decay) + G: 0 for dense states, 1 for clones
    ("Q", _FLOAT, (N_CORE, N_CORE)),  # process noise of one step
    ("prior", _FLOAT, (N_CORE, N_CORE)),  # P at the start
    ("first", _FLOAT, (N_CORE,)),  # x at the start
    ("velocity", _FLOAT),  # 1: the first states are v_x, v_y, which turn by the gyro
    # fast rows: inputs and fast measurements: sums of two columns of the fast row
    ("inputs", _INT),
    ("u_column", _INT, (N_INPUTS, 2)),
    ("u_factor", _FLOAT, (N_INPUTS, 2)),
    ("steer_jump", _FLOAT),  # rad, a step of the first input that a row must confirm; 0: none
    ("steer_before", _FLOAT),  # rad, steering angle of the row before, as it came
    ("fasts", _INT),
    ("y_column", _INT, (N_FAST, 2)),
    ("y_factor", _FLOAT, (N_FAST, 2)),
    ("C_fast", _FLOAT, (N_FAST, N_CORE)),
    ("D_fast", _FLOAT, (N_FAST, N_INPUTS)),
    ("accel_row", _INT),  # the fast measurement that is a bicycle's a_y; without one the last row
    ("accel_scale_state", _INT),
    ("felt", _FLOAT, (N_CORE,)),  # what a_y has of each state besides V (beta' + gamma)
    ("rest_fast", _FLOAT, (N_FAST,)),  # what is measured where states and inputs are zero
    ("r_fast", _FLOAT, (N_FAST,)),  # variances of the fast measurements
    ("r_nominal", _FLOAT, (N_FAST,)),  # configured variances, the least that may be found
    ("r_share", _FLOAT),  # weight of a new block in these variances; 0: fixed
    ("block", _INT),  # rows of a block whose mean innovations show the noise
    ("blocks", _INT),  # blocks so far
    ("block_rows", _INT),  # rows of the present one
    ("block_sum", _FLOAT, (N_FAST,)),  # sums of its innovations
    ("robust", _FLOAT),  # standard deviations from which a residual counts less; 0: none does
    # slow sensors: what each one measures, how noisy it is, when it captures
    ("rows", _INT, (N_SLOW,)),  # rows of C
    ("C", _FLOAT, (N_SLOW, N_ROWS, N_CORE)),
    ("angle", _INT, (N_SLOW, N_ROWS)),  # 1: the residual is wrapped
    ("ground", _INT, (N_SLOW, N_ROWS)),  # 1: a heading over the ground, where psi is the road's
    ("r", _FLOAT, (N_SLOW, N_ROWS)),  # variances of the rows at the present speed
    ("noise_over_speed", _FLOAT, (N_SLOW, N_ROWS)),  # r is this / V^2; 0: r as it stands
    ("heading_fix", _INT, (N_SLOW,)),  # 1: where the first sample is far off, it sets the heading
    # columns of the sensor's packet; 0: it has none
    ("hdop_column", _INT, (N_SLOW,)),
    ("satellites_column", _INT, (N_SLOW,)),
    ("speed_column", _INT, (N_SLOW,)),
    ("r_speed", _FLOAT),  # (m/s)^2, of the speed over ground that a second layer takes
    ("knots", _INT),  # rows of the table HDOP -> factor on a sensor's noise; 0: no table
    ("hdop", _FLOAT, (N_KNOTS,)),
    ("hdop_factor", _FLOAT, (N_KNOTS,)),
    ("least_satellites", _FLOAT),  # packets with fewer are refused
    ("gate", _FLOAT, (N_ROWS + 1,)),  # by dimension, the largest NIS; 0: no gate
    ("recovery_count", _INT),  # gated samples in agreement that restore a sensor's trust; 0: never
    ("r_scale_weight", _FLOAT),  # weight of a new innovation in the scale of R; 0: R as configured
    ("first_slow", _INT),  # index of the first slow sensor that is used; -1: none
    ("period", _INT, (N_SLOW,)),  # ticks; 0: not used
    ("phase", _INT, (N_SLOW,)),  # tick of the first capture
    ("stride", _INT),  # ticks of one step of the filter
    ("pace", _INT),  # ticks between two steps that listen to sensors
    ("origin", _INT),  # tick, phase of a single-rate filter's steps
    # the rule for late samples: codes stand in `late_samples`
    ("delay_rule", _INT),  # code of the rule, such as CLONE
    ("frames", _INT, (N_SLOW,)),  # captured and not here yet, at most; CLONE, LARSEN
    ("first_clone", _INT, (N_SLOW,)),  # where its clones start in x; 0 or WEIGHED: it has none
    ("stored", _INT),  # states whose predictions are stored; STORED, CONSTANT, below a second layer
    ("assumed", _INT),  # ticks, assumed delay; CONSTANT
    # gains
    ("gain_rule", _INT),  # code of the rule, such as GAIN.covariance
    ("cycle", _INT),  # steps after which the schedule repeats
    ("pattern", _INT),  # frames in the schedule's cycle
    ("low", _FLOAT),  # m/s, speed of the first table of gains
    ("high", _FLOAT),  # m/s, speed of the last table
    ("spacing", _FLOAT),  # m/s between tables; 0: one table
    ("inverse", _FLOAT, (N_FAST + N_ROWS, N_TOTAL)),  # C^+ transposed; split
    # speed
    ("measured", _INT),  # 1: from the wheels, 0: fixed
    ("smoothing", _FLOAT),  # weight of a new sample in the low-pass; 0: fixed
    ("speed", _FLOAT),  # m/s, low-passed
    ("model_speed", _FLOAT),  # m/s, speed of the present model
    ("beta_scale", _FLOAT),  # old speed over new, by which beta = v_y / V is scaled before a step
    ("speed_before", _FLOAT),  # m/s, speed of the model at the row before
    ("turning", _FLOAT),  # rad/s, the present model's yaw rate; velocities
    ("cell", _INT),  # the present table of gains
    ("missing_cell", _INT),  # the table that is missing; -1: none
    # state of the filter now
    ("start", _INT),  # tick of the first row
    ("tick", _INT),  # tick of the last row
    ("has_started", _INT),  # 1: there was a first step
    ("road_turn", _FLOAT),  # rad, by which the road has turned since the first row
    ("at", _INT),  # index of the present step in the schedule's cycle
    ("x", _FLOAT, (N_TOTAL,)),  # states, then clones
    ("P", _FLOAT, (N_TOTAL, N_TOTAL)),
    ("u", _FLOAT, (N_INPUTS,)),  # the last finite inputs
    ("u_sum", _FLOAT, (N_INPUTS,)),  # sum over `u_count` ticks since the last step; stride > 1
    ("u_count", _INT),
    ("y", _FLOAT, (N_FAST,)),  # fast measurements of this tick; NaN: none
    ("cursor", _INT),  # packets of the present call that are done
    ("counts", _INT, (len(SkipCounters._fields),)),
    ("scale", _FLOAT, (N_SLOW, N_ROWS)),  # factor on R, where it adapts
    # of filters that find noise, means of squared innovations over variances: of the fast rows
    # of the last second, of the last dozen slow samples; 1 where the filter knows how it errs
    ("surprise", _FLOAT, (2,)),
    ("nis", _FLOAT),  # normalised innovation squared of the last packet; NaN: unknown
    # of each slow sensor, where `recovery_count` is above 0
    ("last", _FLOAT, (N_SLOW, PACKET_WIDTH)),  # its last packet
    ("last_accepted", _INT, (N_SLOW,)),  # tick of the last sample that was used; -1: none was
    ("rejections", _INT, (N_SLOW,)),  # gated samples since then that agree with each other
    ("first_rejected", _INT, (N_SLOW,)),  # tick of the first of them
    ("rejected_residual", _FLOAT, (N_SLOW, N_ROWS)),  # residual of the last of them
    ("first_fix", _INT),  # captured tick of the first heading fix; -1: none yet
    ("next", _INT, (N_SLOW,)),  # tick of the next capture
    ("known_stamps", _INT, (N_SLOW, N_STAMPS)),  # captured ticks of frames that came
    ("stamp", _INT, (N_SLOW, N_FRAMES)),  # captured tick of each frame that is due; -1: none
    ("speed_captured", _FLOAT, (N_SLOW, N_FRAMES)),  # m/s, speed of the model at that tick; CLONE
    ("waiting", _FLOAT, (N_WAITING, PACKET_WIDTH)),  # packets for the next step; pace > 1
    ("waits", _INT),  # how many packets wait
    ("sample", _FLOAT, (PACKET_WIDTH,)),  # the packet at hand
    # LARSEN: what the residual of a frame that is due will do to the states, and its expectation
    ("larsen_gain", _FLOAT, (N_SLOW, N_ROWS, N_CORE)),
    ("larsen_expected", _FLOAT, (N_SLOW, N_ROWS)),
    # corrections between slow samples
    ("tick_gains", _FLOAT, (N_FAST + N_ROWS, N_TOTAL)),  # of a tick, fast and slow rows, from P
    ("e", _FLOAT, (N_TOTAL,)),  # estimated error, tie-vision (18); split, pseudo
    ("expected", _FLOAT, (N_ROWS,)),  # C x before a tick's corrections; split, pseudo
    ("eps", _FLOAT, (N_FAST + N_ROWS,)),  # residuals of this tick: fast, slow rows; joint, pseudo
    ("innovation", _FLOAT, (N_ROWS,)),  # innovation of the last sample; dual_rate
    ("since", _INT),  # steps since the last sample; -1: there was none; dual_rate
    ("to_line", _INT, (3,)),  # unused: with it the matrices, sorted behind, begin on cache lines
    # scratch
    ("u_new", _FLOAT, (N_INPUTS,)),
    ("PC", _FLOAT, (N_TOTAL,)),  # P C^T
    ("gain", _FLOAT, (N_TOTAL,)),  # gain of the last measurement
    ("residual", _FLOAT, (N_ROWS,)),  # residuals of the sample at hand
    ("S", _FLOAT, (N_ROWS, N_ROWS)),  # covariance of `residual`, then its Cholesky factor
    ("white", _FLOAT, (N_ROWS,)),  # `residual`, whitened by that factor
    ("e_seen", _FLOAT, (N_FAST,)),  # C G e of the fast rows
]
_WINDOW = [  # history: of tick k in row k % WINDOW
    ("predicted", _FLOAT, (WINDOW, N_CORE)),  # the first `stored` states
    ("past_road_turn", _FLOAT, (WINDOW,)),  # rad
    # the rest: BUFFER
    ("past_u", _FLOAT, (WINDOW, N_INPUTS)),
    ("past_y", _FLOAT, (WINDOW, N_FAST)),
    ("past_speed", _FLOAT, (WINDOW,)),  # m/s, speed of the model
    ("past_turning", _FLOAT, (WINDOW,)),
    # the last snapshot is "now", while the past is redone
    ("snapshot_x", _FLOAT, (N_SNAPSHOTS + 1, N_CORE)),
    ("snapshot_P", _FLOAT, (N_SNAPSHOTS + 1, N_CORE, N_CORE)),
    ("recent", _FLOAT, (N_RECENT, PACKET_WIDTH)),
    ("recent_r", _FLOAT, (N_RECENT, N_ROWS)),  # r when each of them came
    ("evicted", _INT),  # captured tick of the newest packet that had to go
    ("replay", _INT, (N_RECENT,)),  # scratch: those that are used again
]


_LEADING = (  # what a tick in lanes reads or writes, side by side; x and P lie on cache lines
    *("x", "P", "n", "total", "gain_rule", "measured", "speed", "speed_before", "model_speed"),
    *("tick", "has_started", "cell", "at", "cursor", "road_turn", "period", "next"),
    *("y", "u", "counts"),
)
_RANKS = {name: rank for rank, name in enumerate(_LEADING)}
_FIELDS.sort(key=lambda row: (_RANKS.get(row[0], len(_RANKS)), np.dtype([row]).itemsize))
FILTER = pad_to_cache_line([*_FIELDS, *_WINDOW])
