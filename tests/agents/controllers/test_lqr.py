"""The LQR: its model is the plant, its gains are python-control's, its loops are stable."""

from typing import Any

import control
import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents import Lqr, make_agent
from sideslip.agents.controllers.lqr import _solve_box_qp
from sideslip.agents.design.sampled_model import DYNAMIC, SPEEDS, DesignSpec, make_design_model
from sideslip.envs import COMS, PASSENGER_CAR
from sideslip.envs.task import MODEL, ZERO_SLIP, compute_reference, make_reference_params
from sideslip.envs.vehicle.linear import make_bicycle_model
from sideslip.estimators import EstimateObservation
from tests.agents.helpers import compute_gains, observe

SMALL = {
    "base": "straight", "small_angle": True, "tyres": "linear", "roll": False, "mirror": False,
    "speed": 7.0, "front_stiffness": 1.0, "rear_stiffness": 1.0, "disturbance_force": 0.0,
    "disturbance_moment": 0.0, "noise": {"wheel": 0.0},
}  # fmt: skip


def estimating(env: Any, *disturbances: str) -> Any:
    return EstimateObservation(env, "exact-kf", outputs=["beta", "gamma", *disturbances])


@pytest.fixture
def steered() -> Any:
    return estimating(gym.make("sideslip/AfsYawFusion-v0", scenario=SMALL))


def agent_of(env: Any, **options: Any) -> Lqr:
    agent = make_agent("lqr", env, **options)
    assert isinstance(agent, Lqr)
    return agent


@pytest.mark.parametrize("lag", [0.0, 0.005])
@pytest.mark.parametrize(("period", "rate"), [(1, 0.0), (10, 0.0), (10, 0.00025), (25, 0.00025)])
def test_the_model_is_the_plant_and_its_cost_the_envs(period: int, lag: float, rate: float) -> None:
    """Steps of the env and of x+ = G x + H u, and what they cost, the moment's rate and all."""
    car = {"base": "coms", "motor_lag": lag, "steering_lag": 6.0 * lag, "steering_rate": 1e6}
    scenario = SMALL | {"steering": "step", "onset": -10.0, "hold": 1e6, "amplitude": 0.01}
    built: dict[str, Any] = {"vehicle": car, "control_period": period, "strict": False}
    world = {"moment_rate": rate}
    env: Any = gym.make("sideslip/AfsYawFusion-v0", scenario=scenario, world=world, **built)
    env.reset(seed=0)
    vehicle = env.unwrapped.vehicle
    spec = DesignSpec(period, vehicle.yaw_moment_limit, True, MODEL, moment_rate=rate)
    model = make_design_model(vehicle, 7.0, spec)
    refs = compute_reference(0.01, 7.0, make_reference_params(vehicle), MODEL)
    x = np.zeros(len(model.G))
    x[3:7] = 0.01, 0.01, *refs
    for action in ([0.1, 0.05], [-0.2, 0.1], [0.3, 0.0], [0.3, 0.0]):
        *_, info = env.step(np.array(action, np.float32))
        u = np.array(action, np.float32) * np.array([1.0, vehicle.steering_authority])
        wanted = x @ model.Q @ x + u @ model.R @ u + 2 * x @ model.N @ u
        assert info["cost"] == pytest.approx(wanted, rel=1e-5)
        x = model.G @ x + model.H @ u
        assert (info["beta"], info["gamma"]) == pytest.approx((x[0], x[1]), rel=1e-5)


@pytest.mark.parametrize("rate", [0.0, 0.00025])
@pytest.mark.parametrize("speed", [2.0, 7.0, 30.0])
@pytest.mark.parametrize("kind", [ZERO_SLIP, MODEL])
@pytest.mark.parametrize("steers", [False, True])
def test_gains_are_python_controls_for_all_states_at_once(
    speed: float, kind: int, steers: bool, rate: float
) -> None:
    """`dlqr` itself needs states that can be brought to rest: what is held decays slowly there."""
    purpose = DesignSpec(10, COMS.yaw_moment_limit, steers, kind, "rates", moment_rate=rate)
    model = make_design_model(COMS, speed, purpose)
    G = model.G.copy()
    held = range(len(DYNAMIC), len(G) - (2 if rate else 0))  # the last two are inputs' memory
    G[held, held] *= 1.0 - 1e-8
    wanted, _, _ = control.dlqr(G, model.H, model.Q, model.R, model.N)
    scale = np.abs(wanted).max()
    assert model.solve()[0] / scale == pytest.approx(np.asarray(wanted) / scale, abs=1e-6)


def test_tabled_gains_are_the_designed_ones(steered: Any) -> None:
    agent = agent_of(steered)
    for speed in (SPEEDS[3], SPEEDS[20]):
        wanted = make_design_model(COMS, speed, agent.design_spec).solve()[0]
        assert compute_gains(agent, speed) == pytest.approx(wanted, rel=1e-12)
    assert (compute_gains(agent, 0.1) == compute_gains(agent, SPEEDS[0])).all()
    assert (compute_gains(agent, 99.0) == compute_gains(agent, SPEEDS[-1])).all()


@pytest.mark.parametrize("car", [COMS, PASSENGER_CAR], ids=["coms", "passenger-car"])
@pytest.mark.parametrize("steers", [False, True])
def test_the_closed_loop_is_stable_over_the_speeds(car: Any, steers: bool) -> None:
    """At the tabled speeds and between; the COMS alone is unstable above 17.6 m/s."""
    purpose = DesignSpec(10, car.yaw_moment_limit, steers, MODEL)
    gains = [make_design_model(car, speed, purpose).solve()[0] for speed in SPEEDS[::4]]
    for i, (low, high) in enumerate(zip(SPEEDS[::4], SPEEDS[4::4], strict=False)):
        for share in (0.0, 0.5):
            K = (1.0 - share) * gains[i] + share * gains[i + 1]
            model = make_design_model(car, low + share * (high - low), purpose)
            moved = slice(len(DYNAMIC))  # the states that inputs move
            closed = model.G[moved, moved] - model.H[moved] @ K[:, moved]
            assert np.abs(np.linalg.eigvals(closed)).max() < 1.0


def test_it_follows_the_references_where_they_can_be_had(steered: Any) -> None:
    """With both inputs free of limits, beta and gamma reach the model's steady state."""
    model = make_design_model(COMS, 7.0, agent_of(steered).design_spec)
    K, d = model.solve()[0], len(DYNAMIC)
    refs = compute_reference(0.01, 7.0, make_reference_params(COMS), MODEL)
    held = np.array([0.01, *refs])
    closed = model.G - model.H @ K
    rest = np.linalg.solve(np.eye(d) - closed[:d, :d], closed[:d, d : d + 3] @ held)
    assert rest[:2] == pytest.approx(refs, rel=0.02)


def test_the_law_is_minus_k_x(steered: Any) -> None:
    agent = agent_of(steered)
    told = {
        "wheel_left": 6.9, "wheel_right": 7.1, "torque_left": -1.0, "torque_right": 2.0,
        "steer": 0.001, "steer_command": 0.002, "beta_ref": 1e-4, "gamma_ref": 2e-3,
        "beta_hat": 2e-4, "gamma_hat": 1e-3,
    }  # fmt: skip
    share = 3.0 / (2.0 * COMS.motor_torque)
    x = [2e-4, 1e-3, share, 0.001, 0.002, 1e-4, 2e-3]
    wanted = -compute_gains(agent, 7.0) @ x / [1.0, COMS.steering_authority]
    action, _ = agent.predict(observe(steered, **told))
    assert action == pytest.approx(wanted, rel=1e-4) and np.abs(wanted).max() < 1.0


def disturbed(kind: str) -> Any:
    """An env whose observation has both disturbances: F_d, N_d or the rates d_1, d_2."""
    if kind == "forces":
        return estimating(gym.make("sideslip/YawVision-v0", reference="model"), "F_d", "N_d")
    outputs = ["beta", "gamma", "d1", "d2"]
    return EstimateObservation(gym.make("sideslip/YawGps-v0"), "dakf", outputs=outputs)


@pytest.mark.parametrize(
    ("kind", "levels"),
    [("forces", {"F_d_hat": 30.0, "N_d_hat": -8.0}), ("rates", {"d1_hat": 0.02, "d2_hat": -0.1})],
)
def test_disturbances_are_fed_forward_by_their_gains(kind: str, levels: dict[str, float]) -> None:
    """Of a car that is at rest beside them; each on its own, and both."""
    env = disturbed(kind)
    agent = agent_of(env)
    answers = []
    for share in ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0)):
        d = np.array(list(levels.values())) * share
        action, _ = agent.predict(observe(env, **dict(zip(levels, d, strict=True))))
        answers.append(float(action[0]))
        K = compute_gains(agent, 7.0)[:, len(DYNAMIC) + 3 :]
        assert action == pytest.approx(-K @ d, rel=1e-5)
    assert np.abs(answers).min() > 0.01


def test_a_held_disturbance_is_met_by_the_best_held_yaw_moment() -> None:
    """Where everything rests, 0 = A x + B u + d, the action is the u that costs least there."""
    env = disturbed("rates")
    agent, v = agent_of(env), SPEEDS[10]
    model = make_bicycle_model(COMS, v)
    B = model.B[:, 1] * COMS.yaw_moment_limit
    d, refs = np.array([0.03, -0.1]), np.array([0.002, 0.01])
    scale = np.array([0.02, 0.1])  # of slip and yaw rate in the cost; effort counts 0.01
    per_u, free = -np.linalg.solve(model.A, B) / scale, -np.linalg.solve(model.A, d)
    u = -per_u @ ((free - refs) / scale) / (per_u @ per_u + 0.01)
    beta, gamma = free + per_u * scale * u
    torque = u * COMS.motor_torque
    action, _ = agent.predict(
        observe(
            env, v, torque_left=-torque, torque_right=torque, beta_hat=beta, gamma_hat=gamma,
            beta_ref=refs[0], gamma_ref=refs[1], d1_hat=d[0], d2_hat=d[1],
        )
    )  # fmt: skip
    assert 0.05 < abs(u) < 1.0
    assert action[0] == pytest.approx(u, rel=1e-3)


def test_disturbances_and_gyro_are_read_where_they_are() -> None:
    plain = gym.make("sideslip/YawGps-v0")
    assert "gyro" in agent_of(EstimateObservation(plain, "dakf", outputs=["beta"])).needs
    assert agent_of(estimating(plain)).design_spec.disturbances == "none"
    assert agent_of(estimating(plain, "F_d", "N_d")).design_spec.disturbances == "forces"
    walks = EstimateObservation(plain, "dakf", outputs=["beta", "gamma", "d1", "d2"])
    assert agent_of(walks).design_spec.disturbances == "rates"


def test_another_action_costs_what_the_curvature_says_and_moves_the_rate_limit() -> None:
    """`_compute_input_cost`'s S, in shares of the yaw moment and of the authority; steering that
    was added by somebody else is what the next decision may differ from by a step of the rate."""
    env = estimating(gym.make("sideslip/AfsYawFusion-v0", reference="model"), "F_d", "N_d")
    agent, speed = Lqr(env), float(SPEEDS[8])
    model = make_design_model(agent.vehicle, speed, agent.design_spec)
    S = model.R + model.H.T @ model.solve()[1] @ model.H
    per = np.diag([1.0, agent.authority])
    assert agent.curvature(speed) == pytest.approx(per @ S @ per, rel=1e-9)
    obs = np.array([each.low if each.name == "steer_command" else 0.0 for each in
                    env.get_wrapper_attr("layout")], np.float32)  # fmt: skip
    memory = np.zeros((1, 1))
    free, _ = agent.predict(obs, memory)
    agent.record_action(memory, np.array([[0.0, 0.5]], np.float32))
    taken, _ = agent.predict(obs, memory)
    assert memory[0, 0] == pytest.approx(0.5 * agent.authority)
    planner = make_agent("mpc", env)
    memory, most = np.zeros((1, planner.memory)), np.array([[0.0, 1.0]], np.float32)
    planner.record_action(memory, most)
    step = COMS.steering_rate * 0.01 / agent.authority
    assert planner.predict(obs, memory)[0][1] > 1.0 - step - 1e-6
    assert abs(free[1]) <= step + 1e-6 and abs(taken[1] - 0.5) <= step + 1e-6


@pytest.mark.parametrize("seed", range(30))
def test_nothing_within_the_limits_costs_less(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(2, 2))
    S = root @ root.T + 0.01 * np.eye(2)
    free, (low, high) = rng.normal(size=2) * 3.0, np.sort(rng.normal(size=2))
    u, w = _solve_box_qp(S, 0, free[0], free[1], 1.0, low, high)
    assert abs(u) <= 1.0 and low <= w <= high
    grid = np.stack(np.meshgrid(np.linspace(-1.0, 1.0, 201), np.linspace(low, high, 201)), -1)
    off = grid - free
    costs = np.einsum("...i,ij,...j", off, S, off)
    found = np.array([u, w]) - free
    assert found @ S @ found <= costs.min() + 1e-12


def test_what_is_within_the_limits_stays() -> None:
    S = np.array([[1.0, 0.9], [0.9, 1.0]])
    assert _solve_box_qp(S, 0, 0.3, -0.2, 1.0, -0.5, 0.5) == (0.3, -0.2)
