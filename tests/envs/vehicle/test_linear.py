"""The linear models are the plant: their matrices equal its numerical Jacobian."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete

from sideslip.envs import COMS, PASSENGER_CAR, Vehicle, critical_speed
from sideslip.envs.engine.config import make_car
from sideslip.envs.sensors.inertial import IDEAL_SENSORS, Noise
from sideslip.envs.sensors.slow import (
    FieldOfView,
    MeasurementContext,
    SatelliteGeometry,
    _sample_camera,
    _sample_gps,
)
from sideslip.envs.task import make_reference_params
from sideslip.envs.vehicle.dynamics import DisturbanceForces, Motion, RoadParams, derivative
from sideslip.envs.vehicle.linear import (
    LinearModel,
    make_bicycle_model,
    make_course_model,
    make_roll_model,
    make_vision_model,
)
from sideslip.envs.vehicle.tyres import LINEAR, PlantVariant, TyreInputs, compute_tyre_load

pytestmark = pytest.mark.plain

KMH = 1.0 / 3.6
SPEEDS = [v * KMH for v in range(5, 46, 5)]
VEHICLES = [COMS, COMS.scale_stiffness(0.7, 1.3), PASSENGER_CAR]
MODELS: dict[str, Callable[[Vehicle, float], LinearModel]] = {
    "bicycle": make_bicycle_model,
    "vision": make_vision_model,
    "course": make_course_model,
}
CALM = DisturbanceForces(0.0, 0.0)
SILENT = Noise()._replace(gyro=0.0, camera_psi=0.0, camera_y=0.0, course=0.0)


def seen(
    model: str, x: Any, u: Any, vehicle: Vehicle, v: float, small_angle: int
) -> tuple[Any, Any]:
    """(dx/dt, y) of the model's states and outputs, from the plant's own equations.

    x: beta, gamma, psi, y_l as far as the model has them; u: delta_f, N_z, kappa.
    """
    beta, gamma, psi, y_l = np.append(x, [0.0] * (4 - len(x))).tolist()
    delta_f, N_z, kappa = np.append(u, [0.0] * (3 - len(u))).tolist()
    car, l_pre = make_car(vehicle), vehicle.preview
    road = RoadParams(kappa, -1e3, 1.0)
    bend = 0.5 * kappa * l_pre**2
    v_x, v_y = (v, v * beta) if small_angle else (v * math.cos(beta), v * math.sin(beta))
    state = Motion(v_x, v_y, gamma, psi, 0.0, 0.0, 0.0, y_l - l_pre * psi + bend, 0.0)
    T = 0.5 * N_z * car.r / (0.5 * car.d_r)
    load = compute_tyre_load(TyreInputs(delta_f, -T, T), car, PlantVariant(small_angle, LINEAR))
    rate = derivative(state, load, CALM, car, road, PlantVariant(small_angle, LINEAR))
    if small_angle:  # the held speed: tie-vision (1)
        dbeta = rate.v_y / v
    else:
        dbeta = (v_x * rate.v_y - v_y * rate.v_x) / (v_x**2 + v_y**2)
    dpsi = rate.psi - rate.theta
    dx = [dbeta, rate.gamma, dpsi, rate.y + l_pre * dpsi]
    sky, view = SatelliteGeometry(0.0, 0.0, 0.0, 0.0, 0.0), FieldOfView(1.0, 1.0)
    parts = state, road, car, SILENT, sky, view, IDEAL_SENSORS
    context = MeasurementContext(*parts, small_angle, 0, 0, 0)
    psi_seen, y_seen = _sample_camera(context, (0.0, 0.0))[0][:2]
    course_seen = _sample_gps(context, 1.0, (0.0,) * 4)[0][0]
    outputs = {"gamma": gamma, "psi": psi_seen, "y_l": y_seen, "course": course_seen}
    names = MODELS[model](vehicle, v).outputs
    return np.array(dx[: len(x)]), np.array([outputs[name] for name in names])


@pytest.mark.parametrize("vehicle", VEHICLES, ids=lambda each: each.name)
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("small_angle", [1, 0])
@pytest.mark.parametrize("v", SPEEDS)
def test_matrices_are_the_plants_jacobian(
    name: str, v: float, small_angle: int, vehicle: Vehicle
) -> None:
    model = MODELS[name](vehicle, v)
    n, m = model.B.shape
    # a typical size of each state and input: all columns are compared on one scale
    size = np.array([0.01, 0.05, 0.01, 0.1][:n] + [0.01, 10.0, 0.001][:m])
    exact = np.block([[model.A, model.B], [model.C, np.zeros((len(model.C), m))]])
    # The small-angle plant is linear: a step of any length gives the matrix up to roundings of
    # the intermediate sums. The full plant is odd about straight driving, so that a central
    # difference errs by the third derivative times the step squared, some (1e-4 x 0.01)^2, and
    # by roundings divided by the step.
    step, error = (1.0, 1e-13) if small_angle else (1e-4, 1e-10)
    columns = []
    for j in range(n + m):
        ahead, behind = np.zeros((2, n + m))
        ahead[j], behind[j] = step * size[j], -step * size[j]
        up, down = (
            np.concatenate(seen(name, at[:n], at[n:], vehicle, v, small_angle))
            for at in (ahead, behind)
        )
        columns.append((up - down) / (2.0 * step))
    difference = np.array(columns).T - exact * size
    assert np.abs(difference[:n]).max() <= error * np.abs(exact[:n] * size).max()
    assert np.abs(difference[n:]).max() <= error * np.abs(exact[n:] * size).max()


@pytest.mark.smoke
@pytest.mark.parametrize("V_x", SPEEDS)
def test_vision_is_tie_vision_8_letter_by_letter(V_x: float) -> None:
    m, I, l_f, l_r, C_f, C_r, l_pre = 380.0, 136.08, 0.8, 0.6, 6000.0, 6000.0, 5.135  # noqa: E741
    D = C_f * l_f**2 + C_r * l_r**2
    A = np.array([
        [-2 * (C_f + C_r) / (m * V_x), -1 - 2 * (C_f * l_f - C_r * l_r) / (m * V_x**2), 0, 0],
        [-2 * (C_f * l_f - C_r * l_r) / I, -2 * D / (I * V_x), 0, 0],
        [0, 1, 0, 0],
        [V_x, l_pre, V_x, 0],
    ])  # fmt: skip
    B = np.array([[2 * C_f / (m * V_x), 2 * C_f * l_f / I, 0, 0], [0, 1 / I, 0, 0]]).T
    C = np.array([[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    model = make_vision_model(COMS, V_x)
    # the same operations in another order: a few roundings
    np.testing.assert_allclose(model.A, A, rtol=1e-15, atol=0.0)
    np.testing.assert_allclose(model.B[:, :2], B, rtol=1e-15, atol=0.0)
    np.testing.assert_array_equal(model.C, C)
    np.testing.assert_array_equal(model.B[:, 2], [0.0, 0.0, -V_x, -V_x * l_pre])


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("dt", [0.001, 0.033, 0.2])
def test_discrete_is_the_exact_zero_order_hold(name: str, dt: float) -> None:
    model = MODELS[name](COMS, 25.0 * KMH)
    G, H = model.discretise(dt)
    D = np.zeros((len(model.outputs), len(model.inputs)))
    expected = cont2discrete((model.A, model.B, model.C, D), dt)  # zero-order hold
    # two calls of one matrix exponential, whose own error is some roundings of its largest entry
    assert np.abs(G - expected[0]).max() <= 1e-14 * np.abs(G).max()
    assert np.abs(H - expected[1]).max() <= 1e-14 * np.abs(H).max()
    twice_G, twice_H = model.discretise(2.0 * dt)
    assert np.abs(G @ G - twice_G).max() <= 1e-14 * np.abs(twice_G).max()
    assert np.abs(G @ H + H - twice_H).max() <= 1e-14 * np.abs(twice_H).max()


@pytest.mark.parametrize("vehicle", VEHICLES, ids=lambda each: each.name)
@pytest.mark.parametrize("v", SPEEDS)
def test_references_are_the_models_steady_state(vehicle: Vehicle, v: float) -> None:
    model, target = make_bicycle_model(vehicle, v), make_reference_params(vehicle)
    beta, gamma = np.linalg.solve(model.A, -model.B[:, 0])
    # a 2 x 2 system, ill-conditioned as the speed nears the critical one
    error = 1e-15 * float(np.linalg.cond(model.A))
    assert gamma == pytest.approx(v * target.per_l / (1.0 + target.G * v * v), rel=error)
    expected = (1.0 - target.b_1 * v * v) * target.b_0 / (1.0 + target.G * v * v)
    assert beta == pytest.approx(expected, abs=error)


def test_poles_cross_the_axis_at_the_critical_speed() -> None:
    v = critical_speed(COMS)
    assert np.linalg.eigvals(make_bicycle_model(COMS, 0.999 * v).A).real.max() < 0.0
    assert np.linalg.eigvals(make_bicycle_model(COMS, 1.001 * v).A).real.max() > 0.0
    A = make_bicycle_model(COMS, v).A
    determinant = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    assert abs(determinant) < 1e-14 * abs(A[0, 0] * A[1, 1])  # roundings of the two products


@pytest.mark.parametrize("v", [0.0, -1.0, math.nan])
def test_a_speed_that_is_not_positive_is_refused(v: float) -> None:
    for build in MODELS.values():
        with pytest.raises(ValueError, match="positive speed, got"):
            build(COMS, v)


def make_velocity_roll_model(vehicle: Vehicle, gamma: float) -> LinearModel:
    """double-layer-gps (42): v_x, v_y, phi and phi_dot from both specific forces."""
    body = make_roll_model(vehicle)
    A, B, C = np.zeros((4, 4)), np.zeros((4, 2)), np.zeros((3, 4))
    A[0, 1], A[1, 0], A[2:, 2:] = gamma, -gamma, body.A
    A[1, 2] = -9.81  # double-layer-gps (5)
    B[0, 0], B[1, 1], B[2:, 1:] = 1.0, 1.0, body.B
    C[0, 0] = C[1, 1] = C[2, 3] = 1.0
    states, outputs = ("v_x", "v_y", "phi", "phi_dot"), ("v_x", "v_y", "phi_dot")
    return LinearModel(A, B, C, states, ("a_x", "a_y"), outputs)


def second_layer(x: Any, u: Any, gamma: float, vehicle: Vehicle) -> Any:
    """(dx/dt, a_x, a_y) of the plant: x = v_x, v_y, phi, phi_dot; u = drive and side force in N."""
    car = make_car(vehicle)
    state = Motion(x[0], x[1], gamma, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, x[2], x[3])
    T = 0.5 * car.r * u[0]
    load = compute_tyre_load(TyreInputs(0.0, T, T), car, PlantVariant(1, LINEAR))
    road, push = RoadParams(0.0, 0.0, 1.0), DisturbanceForces(u[1], 0.0)
    rate = derivative(state, load, push, car, road, PlantVariant(1, LINEAR, 1))
    a_x = rate.v_x - gamma * x[1]  # double-layer-gps (4)
    a_y = rate.v_y + gamma * x[0] + 9.81 * x[2]  # (5)
    return np.array([rate.v_x, rate.v_y, rate.phi, rate.phi_dot, a_x, a_y])


@pytest.mark.parametrize("vehicle", VEHICLES, ids=lambda each: each.name)
@pytest.mark.parametrize("gamma", [0.0, 0.3, -0.7])
def test_the_second_layers_matrices_are_the_plants_jacobian(gamma: float, vehicle: Vehicle) -> None:
    """The plant's rates change by A dx + B da, where a is what its accelerometers then measure.

    The small-angle plant is linear in these but for the tyres' v_y / v_x, which acts through a_y.
    """
    model = make_velocity_roll_model(vehicle, gamma)
    x, u = np.array([8.0, 0.2, 0.03, 0.1]), np.array([100.0, 200.0])
    start = second_layer(x, u, gamma, vehicle)
    for j in range(6):
        step = np.zeros(6)
        step[j] = [0.5, 0.1, 0.02, 0.2, 50.0, 80.0][j]
        moved = second_layer(x + step[:4], u + step[4:], gamma, vehicle) - start
        expected = model.A @ step[:4] + model.B @ moved[4:]
        np.testing.assert_allclose(moved[:4], expected, rtol=0.0, atol=1e-11)  # rates up to 100
    body = make_roll_model(vehicle)
    names = ("phi", "phi_dot"), ("a_y",), ("phi_dot",)
    assert (body.states, body.inputs, body.outputs) == names and body.C.tolist() == [[0.0, 1.0]]


def test_slip_cannot_be_seen_from_the_wheels_alone_at_zero_yaw_rate() -> None:
    """double-layer-gps, 5.2: the kinematic observer is blind there, the second layer is not."""

    def rank(gamma: float, states: int, outputs: int) -> int:
        model = make_velocity_roll_model(COMS, gamma)
        A, C = model.A[:states, :states], model.C[:outputs, :states]
        powers = [np.linalg.matrix_power(A, k) for k in range(states)]
        return int(np.linalg.matrix_rank(np.vstack([C @ power for power in powers])))

    assert (rank(0.0, 2, 1), rank(0.1, 2, 1)) == (1, 2)  # v_x and v_y by the wheels alone
    assert rank(0.0, 4, 3) == 4


@pytest.mark.parametrize("name", MODELS)
def test_to_control_keeps_matrices_and_names(name: str) -> None:
    pytest.importorskip("control")
    model = MODELS[name](COMS, 25.0 * KMH)
    system = model.to_control()
    for letter in "ABC":
        np.testing.assert_array_equal(getattr(system, letter), getattr(model, letter))
    assert not system.D.any()
    assert tuple(system.state_labels) == model.states
    assert tuple(system.input_labels) == model.inputs
    assert tuple(system.output_labels) == model.outputs
    assert system.isctime()
