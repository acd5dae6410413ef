"""Outputs of an env-step: packets of the slow sensors, float32 observation, report; compiled.

Packets are captured at a tick and delivered at their arrival in the order (captured tick, sensor);
those under way lie in the state.

Args:
    k: Index of the slow sensors' first entry in the observation.
"""

from ..numerics.functions import FOREVER, NEVER, TICK, clip
from ..numerics.jit import copy_into, jit, noinline
from ..numerics.packed import load_element, read, store_element, write
from ..numerics.primitives import Matrix, Scalar, Vector, maximum, minimum, select, to_word
from ..record import FAST, PACKET, PACKET_WIDTH
from ..sensors.link import Link, compute_arrivals
from ..sensors.slow import BLOCKS, NEEDS_QUALITY, VALUES, WIDTHS, MeasurementContext, sample_sensor
from ..task import AGE_CAP, N_SAMPLED, REPORT, compute_reference
from ..vehicle.dynamics import Motion, compute_sideslip_angle
from .layout import FLAGS, EpisodeArrays, P, Z
from .window import WINDOW


@jit
def _push_packet(
    z: Vector, sensor: int, captured: Scalar, due: Scalar, quality: Scalar, frame: Scalar,
    values: Vector,
) -> None:  # fmt: skip
    """Queue a captured sample; `make_link` has checked that the queue is long enough."""
    slot = int(z[Z.under_way])
    packet = z[Z.queue + slot * PACKET_WIDTH :]
    packet[PACKET.sensor], packet[PACKET.captured], packet[PACKET.arrived] = sensor, captured, due
    packet[PACKET.quality], packet[PACKET.sequence] = quality, frame
    for i in range(VALUES):
        packet[PACKET.value + i] = values[i]
    z[Z.under_way], z[Z.clock.next_due] = slot + 1.0, minimum(z[Z.clock.next_due], due)


@jit
def _send_frame(
    z: Vector, sensor: int, link: Link, tick: Scalar, key: Vector, values: Vector, quality: Scalar
) -> None:
    """Queue a slow sensor's frame for its arrivals, and set the sensor's clock on."""
    column = Z.slow[sensor]
    frame = z[column.frames]
    first, second = compute_arrivals(link, frame, tick, key[0], key[1], BLOCKS[sensor].link)
    stamp = tick + link.stamp  # nothing arrives before it
    if first != NEVER:
        _push_packet(z, sensor, stamp, maximum(first, stamp), quality, frame, values)
    if second != NEVER:
        _push_packet(z, sensor, stamp, maximum(second, stamp), quality, frame, values)
    z[column.frames], z[column.next_capture] = frame + 1.0, tick + link.period


@jit
def update_newest(z: Vector, packet: Vector, tick: Scalar) -> None:
    """Take a delivered packet as its sensor's newest sample, if it is newer.

    Args:
        z: Packed state, shape (STATE_WIDTH,).
        packet: The packet, shape (PACKET_WIDTH,).
        tick: Tick of its arrival.
    """
    sensor = int(packet[PACKET.sensor])
    newest = Z.slow[sensor]
    is_empty = NEEDS_QUALITY[sensor] and packet[PACKET.quality] <= 0.0
    if not is_empty and packet[PACKET.captured] > z[newest.captured]:
        z[newest.captured] = packet[PACKET.captured]
        for i in range(VALUES):
            z[newest.values[0] + i] = packet[PACKET.value + i]
        z[newest.arrived] = tick


@jit
def _move_due_packets(z: Vector, tick: Scalar, packets: Matrix, count: int) -> int:
    """Move the packets that arrive at this tick into `packets`; return the new count."""
    while True:
        best, best_rank, due = -1, FOREVER, FOREVER
        under_way = int(z[Z.under_way])
        for slot in range(under_way):
            offset = Z.queue + slot * PACKET_WIDTH
            arrived = z[offset + PACKET.arrived]
            if arrived == tick:
                rank = len(Z.slow) * z[offset + PACKET.captured] + z[offset + PACKET.sensor]
                if rank < best_rank:
                    best, best_rank = offset, rank
            else:
                due = minimum(due, arrived)
        if best < 0:
            z[Z.clock.next_due] = due
            return count
        for i in range(PACKET_WIDTH):
            packets[count, i] = z[best + i]
        update_newest(z, packets[count], tick)
        last = Z.queue + (under_way - 1) * PACKET_WIDTH  # the last packet takes the free place
        for i in range(PACKET_WIDTH):
            z[best + i] = z[last + i]
        z[Z.under_way] = under_way - 1.0
        count += 1


@jit
def make_measurement_context(
    p: Vector, motion: Motion, small_angle: int, key: Vector, tick: Scalar
) -> MeasurementContext:
    """Make the inputs of the slow sensors' measurements at a tick.

    Args:
        p: Packed parameters, shape (PARAMS_WIDTH,).
        motion: Motion of the car.
        small_angle: 1 for the small-angle plant.
        key: Lower and upper 32 bits of the episode's key.
        tick: Tick of the measurement.
    """
    return MeasurementContext(
        motion, read(p, P.road), read(p, P.car), read(p, P.noise), read(p, P.sky),
        read(p, P.field_of_view), read(p, P.errors), small_angle, key[0], key[1], tick,
    )  # fmt: skip


@jit
def _sample_slow_sensors(row: EpisodeArrays, motion: Motion, tick: Scalar, count: int) -> int:
    """Sample the slow sensors at a tick and deliver due packets; return the step's new count."""
    p, z, small_angle = row.p, row.z, row.switches[FLAGS.small_angle]
    key = (to_word(z[Z.clock.key_low]), to_word(z[Z.clock.key_high]))
    for sensor in range(len(Z.slow)):
        column = Z.slow[sensor]
        if tick == z[column.next_capture]:
            link = read(p, P.slow[sensor])
            context = make_measurement_context(p, motion, small_angle, key, tick)
            values, quality, z[column.drift] = sample_sensor(sensor, context, link, z[column.drift])
            _send_frame(z, sensor, link, tick, key, values, quality)
    if tick >= z[Z.clock.next_due]:
        count = _move_due_packets(z, tick, row.packets, count)
    return count


@jit
def observe(row: EpisodeArrays, n: int, count: int, refs: Vector) -> None:
    """Write the float32 observation, clipped at its bounds."""
    _observe_slow(row, observe_fast(row, n, refs), count)


@jit
def observe_fast(row: EpisodeArrays, n: int, refs: Vector) -> int:
    """Write the observation's fast entries, whose number it returns, last the two references."""
    rows, bounds, switches, obs, k = row.rows, row.bounds, row.switches, row.obs, 0
    for column in range(N_SAMPLED):
        if switches[FLAGS.all_samples]:
            for j in range(n):
                _store_clipped(obs, load_element(rows, j, column), bounds, k)
                k += 1
        else:
            total = 0.0
            for j in range(n):
                total = total + load_element(rows, j, column)
            _store_clipped(obs, load_element(rows, n - 1, column), bounds, k)
            _store_clipped(obs, total / n, bounds, k + 1)
            k += 2
    for i in range(4):  # steering angle, both torques, the driver's steering command
        _store_clipped(obs, load_element(rows, n - 1, FAST.steer + i), bounds, k)
        k += 1
    if switches[FLAGS.with_map]:
        _store_clipped(obs, load_element(rows, n - 1, FAST.curvature), bounds, k)
        k += 1
    last = len(obs) - 2
    _store_clipped(obs, refs[0], bounds, last)
    _store_clipped(obs, refs[1], bounds, last + 1)
    return k


@jit
def _store_clipped(obs: Vector, value: Scalar, bounds: Matrix, k: int) -> None:
    """Store entry k of an observation, clipped at its bounds (2, k)."""
    store_element(obs, clip(value, bounds[0, k], bounds[1, k]), k)


@jit
def _observe_slow(row: EpisodeArrays, k: int, count: int) -> None:
    """Write the observation's entries of the slow sensors, from entry k on."""
    p, z, obs, packets, bounds = row.p, row.z, row.obs, row.packets, row.bounds
    tick = z[Z.clock.tick]
    for sensor in range(len(Z.slow)):
        newest = Z.slow[sensor]
        if p[P.slow[sensor].period] > 0.0:
            for i in range(WIDTHS[sensor]):
                obs[k] = clip(z[newest.values[0] + i], bounds[0, k], bounds[1, k])
                k += 1
            age = (tick - z[newest.captured]) * TICK
            obs[k] = clip(select(z[newest.captured] != NEVER, age, AGE_CAP), 0.0, AGE_CAP)
            is_fresh = 0.0
            for i in range(count):
                # the newest sample's own packet, neither an older one nor a duplicate
                is_newest = packets[i, PACKET.arrived] == z[newest.arrived]
                if packets[i, PACKET.sensor] == sensor and is_newest:
                    is_fresh = 1.0
            obs[k + 1] = is_fresh
            k += 2


@jit
def finish_step(row: EpisodeArrays, n: int, done: int) -> None:
    """Do slow sensors, observation and report of one vehicle's step."""
    finish_slow_sensors(row, done, _observe_step(row, n, done))


@noinline
def finish_slow_sensors(row: EpisodeArrays, done: int, k: int) -> None:
    """Do slow sensors and report of one vehicle's step."""
    _finish_report(row, k, sample_slow_ticks(row, 0, done, 0, done))


@jit
def _find_next_due(z: Vector, tick: Scalar) -> Scalar:
    """Find the first tick after this one at which a slow sensor captures or a packet arrives."""
    due = maximum(z[Z.clock.next_due], tick + 1.0)
    for sensor in range(len(Z.slow)):
        capture = z[Z.slow[sensor].next_capture]
        due = select(capture > tick, minimum(due, capture), due)
    return due


@jit
def sample_slow_ticks(row: EpisodeArrays, first: int, last: int, count: int, done: int) -> int:
    """Sample the slow sensors at the ticks of rows first to last - 1; returns the new `count`.

    Args:
        row: Arrays of the episode.
        first: First of the rows; row 0 is the step's first tick.
        last: The row behind the last one.
        count: Number of packets of the step that were delivered before.
        done: Ticks integrated in the step.
    """
    z = row.z
    start_tick = z[Z.clock.tick] - done
    tick = _find_next_due(z, start_tick + first)
    while tick <= start_tick + last:
        j = int(tick - start_tick) - 1
        count = _sample_slow_sensors(row, read(row.window, WINDOW.track, j), tick, count)
        tick = _find_next_due(z, tick)
    return count


@jit
def _observe_step(row: EpisodeArrays, n: int, done: int) -> int:
    """Write the observation but for the slow sensors, whose first entry's index is returned."""
    refs = (row.report[REPORT.beta_ref], row.report[REPORT.gamma_ref])
    if row.switches[FLAGS.all_samples]:  # the last one stands for the missing
        for j in range(done, n):
            copy_into(row.rows[done - 1], row.rows[j])
        done = n
    return int(observe_fast(row, done, refs))


@jit
def _finish_report(row: EpisodeArrays, k: int, count: int) -> None:
    """Write the report, and the observation of the slow sensors from entry k on."""
    report, z = row.report, row.z
    _observe_slow(row, k, count)
    report[REPORT.t] = z[Z.clock.tick] * TICK
    report[REPORT.gamma], report[REPORT.psi] = z[Z.motion.gamma], z[Z.motion.psi]
    report[REPORT.failure], report[REPORT.reward] = z[Z.clock.failure], -report[REPORT.cost]
    report[REPORT.packets] = count


@jit
def finish_reset(row: EpisodeArrays) -> None:
    """Do slow sensors, references, observation and report of tick 0."""
    z, rows, switches, report = row.z, row.rows, row.switches, row.report
    motion, target = read(z, Z.motion), read(row.p, P.target)
    count = _sample_slow_sensors(row, motion, 0.0, 0)
    v = 0.5 * (rows[0, FAST.wheel_left] + rows[0, FAST.wheel_right])
    refs = compute_reference(rows[0, FAST.steer_command], v, target, switches[FLAGS.reference])
    write(z, refs, Z.refs)
    beta = compute_sideslip_angle(motion.v_x, motion.v_y, switches[FLAGS.small_angle])
    report[REPORT.beta], report[REPORT.steer] = beta, z[Z.drive.delta_f]
    report[REPORT.beta_ref], report[REPORT.gamma_ref] = refs
    report[REPORT.yaw_moment] = report[REPORT.cost] = report[REPORT.ended] = 0.0
    _finish_report(row, _observe_step(row, len(rows), 1), count)  # tick 0 stands for all samples
    report[REPORT.reward] = 0.0
