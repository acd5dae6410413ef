"""The linear car of the papers' small-angle simulations, exactly, for the estimators' tests.

Inputs and disturbances are held over a tick, so the zero-order hold of `envs.vehicle.linear` is
exact. The body rolls with the lateral acceleration and does not act back: double-layer-gps (3)-(5).
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from sideslip.envs.record import FAST, FAST_WIDTH, PACKET, PACKET_WIDTH, Log, Record
from sideslip.envs.sensors.link import SlowSensor
from sideslip.envs.sensors.slow import SLOW_NAMES
from sideslip.envs.vehicle.linear import LinearModel, make_vision_model
from sideslip.envs.vehicle.parameters import COMS, GRAVITY, Vehicle

KMH = 1.0 / 3.6
CAMERA = SlowSensor(period=0.033, delays=(0.030,))
GPS = SlowSensor(period=0.2)


@dataclass(frozen=True)
class Drive:
    """A drive at a held speed. wind: (N, arm in m, from s, to s); outage: of the GPS."""

    amplitude: float = 0.1
    frequency: float = 0.5
    onset: float = 0.0
    periods: float = 1e9
    duration: float = 10.0
    speed: float = 25.0 * KMH
    real: float = 7200.0
    nominal: float = 6000.0
    wind: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    outage: tuple[float, float] = (0.0, 0.0)

    @property
    def truth(self) -> Vehicle:
        return COMS.replace(front_stiffness=self.real, rear_stiffness=self.real)

    @property
    def told(self) -> Vehicle:
        return COMS.replace(front_stiffness=self.nominal, rear_stiffness=self.nominal)


FIG7 = Drive()
FIG6 = Drive(
    amplitude=0.2, frequency=0.2, onset=0.5, periods=1.0, real=7000.0, nominal=10000.0,
    wind=(200.0, 0.2, 4.0, 8.0), outage=(4.0, 6.0),
)  # fmt: skip


def simulate(
    drive: Drive, slow: dict[str, SlowSensor], seed: int, gyro_bias: float = 0.0,
    disturbed: bool = True, quiet: bool = False,
) -> Log:  # fmt: skip
    """A log with the truth. disturbed: OU force and moment of 50 N, 20 N m, 0.3 s. quiet: without
    sensor noise."""
    rng = np.random.default_rng(seed)
    dt, V = 0.001, drive.speed
    K = round(drive.duration / dt)
    car = drive.truth
    model = make_vision_model(car, V)
    push = np.zeros((4, 2))
    push[0, 0], push[1, 1] = 1.0 / (car.mass * V), 1.0 / car.yaw_inertia
    B = np.hstack([model.B, push])
    wide = type(model)(model.A, B, model.C, model.states, (), model.outputs)
    G, H = wide.discretise(dt)
    t = np.arange(K + 1) * dt
    on = (t >= drive.onset) & ((t - drive.onset) * drive.frequency < drive.periods)
    steer = drive.amplitude * np.sin(2.0 * math.pi * drive.frequency * (t - drive.onset)) * on
    sd = np.array([50.0, 20.0]) * disturbed
    keep = math.exp(-dt / 0.3)
    drawn = sd * rng.standard_normal((K + 1, 2))
    drawn[1:] *= math.sqrt(1.0 - keep * keep)
    ou = lfilter([1.0], [1.0, -keep], drawn, axis=0)
    force, arm, start, end = drive.wind
    blowing = ((t >= start) & (t < end))[:, None] * np.array([force, force * arm])
    acting = np.column_stack([steer, np.zeros((K + 1, 2)), ou + blowing]) @ H.T
    x = np.zeros((K + 1, 4))
    for k in range(K):
        x[k + 1] = G @ x[k] + acting[k]
    noisy = 0.0 if quiet else 1.0
    fast = np.zeros((K + 1, FAST_WIDTH))
    fast[:, FAST.gyro] = x[:, 1] + gyro_bias + noisy * 0.005 * rng.standard_normal(K + 1)
    fast[:, FAST.wheel_left] = V - 0.5 * car.front_track * x[:, 1]
    fast[:, FAST.wheel_right] = V + 0.5 * car.front_track * x[:, 1]
    fast[1:, FAST.steer] = steer[:-1]
    fast[0, FAST.steer] = steer[0]
    packets = _packets(drive, slow, x, K, noisy, rng)
    truth = {"beta": x[:, 0], "gamma": x[:, 1], "psi": x[:, 2], "y_l": x[:, 3]}
    pushed = np.column_stack([steer, np.zeros((K + 1, 2)), ou + blowing])
    pushed = np.vstack([pushed[:1], pushed[:-1]])  # what acted until this tick
    truth |= _bodily(drive, fast, x, V * ((x @ wide.A.T + pushed @ wide.B.T)[:, 0] + x[:, 1]))
    own = np.random.default_rng([seed, 1])
    for column, level in ((FAST.accel_y, 0.1), (FAST.accel_x, 0.1), (FAST.roll_rate, 0.005)):
        fast[:, column] += noisy * level * own.standard_normal(K + 1)
    return Log(Record(fast, packets), slow, truth)


def _bodily(
    drive: Drive, fast: np.ndarray, x: np.ndarray, across: np.ndarray
) -> dict[str, np.ndarray]:
    """Write what accelerometers and roll gyro feel; the truth of velocities and roll.

    across: (K + 1,) v_y' + gamma v_x in m/s2; a_y is that and gravity's share, (5).
    """
    car = drive.truth
    lift = car.sprung_mass * car.roll_arm / car.roll_inertia
    A = np.array([[0.0, 1.0], [lift * GRAVITY - car.roll_stiffness / car.roll_inertia, 0.0]])
    A[1, 1] = -car.roll_damping / car.roll_inertia
    roll = LinearModel(A, np.array([[0.0], [lift]]), np.eye(2), ("phi", "phi_rate"), (), ())
    G, H = roll.discretise(0.001)
    phi = np.zeros((len(x), 2))
    for k in range(len(x) - 1):
        phi[k + 1] = G @ phi[k] + H[:, 0] * across[k]
    fast[:, FAST.accel_y] = across + GRAVITY * phi[:, 0]
    fast[:, FAST.accel_x] = -x[:, 1] * drive.speed * x[:, 0]  # (4) at a held v_x
    fast[:, FAST.roll_rate] = phi[:, 1]
    v_x = np.full(len(x), drive.speed)
    return {"v_x": v_x, "v_y": drive.speed * x[:, 0], "phi": phi[:, 0], "phi_rate": phi[:, 1]}


def _packets(
    drive: Drive, slow: dict[str, SlowSensor], x: np.ndarray, K: int, noisy: float,
    rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    rows = []
    course_sd = math.radians(0.14) * (60.0 * KMH) / drive.speed
    for name, sensor in slow.items():
        period, phase = round(sensor.period * 1e3), round((sensor.phase or 0.0) * 1e3)
        for i, k in enumerate(range(phase, K + 1, period)):
            late = round(sensor.delays[i % len(sensor.delays)] * 1e3)
            late += int(rng.integers(0, round(sensor.jitter * 1e3) + 1))
            n = noisy * rng.standard_normal(2)
            row = np.zeros(PACKET_WIDTH)
            row[: PACKET.value] = SLOW_NAMES.index(name), k, k + late, 1.0, i
            if name == "camera":
                row[PACKET.value : PACKET.value + 2] = x[k, 2:] + n * (3.5e-3, 0.02)
            else:
                row[PACKET.value] = x[k, 0] + x[k, 2] + course_sd * n[0]
                row[PACKET.value + 1] = drive.speed + 0.05 * n[1]
                row[PACKET.value + 4 :] = 1.0, 12.0  # HDOP, satellites
                if drive.outage[0] <= k * 1e-3 < drive.outage[1]:
                    continue
            if k + late <= K:
                rows.append(row)
    packets = np.array(rows).reshape(-1, PACKET_WIDTH)
    columns = [PACKET.sensor, PACKET.captured, PACKET.arrived]
    order = np.lexsort(packets[:, columns].T)
    return packets[order]


def error(estimates: object, log: Log, start: float = 2.0) -> float:
    """Mean squared error of beta from `start` seconds on."""
    late = log.time >= start - 1e-9
    return float(np.mean((estimates["beta"] - log.truth["beta"])[late] ** 2))  # type: ignore[index]
