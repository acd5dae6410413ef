"""Where gradients end: detach, resets, failures, overflow, corners; and bad input."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs import SCENARIOS

from ..helpers import FULL

torch = pytest.importorskip("torch")

from sideslip.envs.device import DeviceVectorEnv, make_device_env  # noqa: E402
from sideslip.envs.engine.layout import P  # noqa: E402

from ..batches import batch  # noqa: E402
from .moments import EXACT, FUSION, largest_error  # noqa: E402

pytestmark = pytest.mark.plain


def leaf(*values: float) -> Any:
    return torch.tensor(values, dtype=torch.float64, requires_grad=True)


def made(count: int = 2, **arguments: Any) -> DeviceVectorEnv:
    env = make_device_env(FUSION, count, grad=True, **{"control_period": 3, **arguments})
    assert isinstance(env, DeviceVectorEnv)
    return env


def slope(of: Any, to: Any) -> Any:
    (found,) = torch.autograd.grad(of.sum(), to, retain_graph=True, allow_unused=True)
    return None if found is None else found.tolist()


def test_detach_cuts_the_state_and_leaves_the_parameters() -> None:
    env, v_y = made(), leaf(0.1, 0.2)
    mass = torch.tensor([400.0, 410.0], requires_grad=True)  # float32
    env.reset(seed=0, options={"parameters": {"mass": mass}, "state": {"v_y": v_y}})
    first = torch.zeros(2, 1, dtype=torch.float64, requires_grad=True)
    env.step(first)
    assert slope(env.motion, first) is not None
    total: Any = env.motion.sum()
    total.backward()
    assert (mass.grad != 0.0).all()
    with torch.no_grad():
        mass += 50.0  # as an optimiser does
    env.detach()
    assert not env.motion.requires_grad
    before, mass.grad = env.motion, None
    env.step(torch.zeros(2, 1))
    assert slope(env.motion, first) is None
    assert slope(env.motion, v_y) is None
    total = env.motion.sum()
    total.backward()  # a second time: the graph of before is not asked for
    assert (mass.grad != 0.0).all()
    snapshot = env.get_state()
    assert snapshot["params"][:, P.car.m].tolist() == [450.0, 460.0]
    assert (before - env.motion).abs().max() > 0.0


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_row_that_starts_anew_knows_nothing_of_before(mode: str) -> None:
    """Neither of its actions nor of the parameters, and its neighbour goes on with both."""
    env, C_f = made(autoreset_mode=mode), leaf(2e4, 2e4)
    options = {"duration": [0.006, 1.0], "parameters": {"front_stiffness": C_f}}
    env.reset(seed=0, options=options)
    actions = torch.full((2, 1), 0.1, dtype=torch.float64, requires_grad=True)
    env.step(actions)
    _, rewards, _, truncated, _ = env.step(actions)
    assert truncated.tolist() == [True, False]
    assert (torch.tensor(slope(rewards, actions)) != 0.0).all()
    env.step(torch.zeros(2, 1))
    obs = env.step(torch.zeros(2, 1))[0]
    for inputs in (actions, C_f):
        ended, going = np.ravel(slope(obs[:, 0], inputs))
        assert ended == 0.0
        assert going != 0.0
    env.detach()
    obs = env.step(torch.zeros(2, 1))[0]
    ended, going = slope(obs[:, 0], C_f)
    assert ended == 0.0
    assert going != 0.0
    assert env.get_state()["params"][1, P.car.C_f] == 2e4


def test_a_friction_stands_where_a_rows_scenario_has_none_of_its_own() -> None:
    for right in ([0.3, None], [None, 0.3]):
        env, friction = made(scenario="gust"), leaf(0.77, 0.77)
        scenarios = [{"base": "gust", "friction_right": value} for value in right]
        options = {"scenario": scenarios, "parameters": {"friction": friction}}
        env.reset(seed=0, options=options)
        expected = [value or 0.77 for value in right]
        assert env.get_state()["params"][:, P.car.mu_r].tolist() == pytest.approx(expected)
        assert env.get_state()["params"][:, P.car.mu].tolist() == pytest.approx([0.77, 0.77])


def test_a_reset_by_a_mask_leaves_the_other_rows_their_graph() -> None:
    env, first, second = made(), leaf(0.1, 0.2), leaf(0.3, 0.4)
    env.reset(seed=0, options={"state": {"v_y": first, "gamma": 0.1}})
    env.step(torch.zeros(2, 1))
    mask = torch.tensor([False, True])
    env.reset(seed=1, options={"state": {"v_y": second}, "reset_mask": mask})
    assert env.motion[:, 1].tolist()[1] == 0.4
    env.step(torch.zeros(2, 1))
    one, other = slope(env.motion, first), slope(env.motion, second)
    assert one[0] != 0.0 == one[1]
    assert other[0] == 0.0 != other[1]


def test_numbers_that_overflow_leave_the_other_rows_their_gradients() -> None:
    """A car of a gram on linear tyres that rolls backwards is lost in nine ticks, and stays so."""
    light = {"base": "coms", "mass": 1e-3, "yaw_inertia": 1e-3}
    scenario = FULL | {"tyres": "linear", "small_angle": True, "half_width": 1e300}
    env = made(3, scenario=scenario, strict=False, on_bad_action="fail", autoreset_mode="Disabled")
    C_f, v_y = torch.tensor(2e4, dtype=torch.float64, requires_grad=True), leaf(0.1, 0.1, 0.1)
    options: dict[str, Any] = {
        "vehicle": [light, "coms", "coms"],
        "parameters": {"front_stiffness": C_f},
    }
    options["state"] = {"v_y": v_y, "v_x": torch.tensor([-5.0, 5.0, 5.0]), "gamma": 0.1}
    env.reset(seed=0, options=options)
    actions = torch.full((3, 1), 0.1, dtype=torch.float64)
    actions[2] = torch.nan
    actions.requires_grad_()
    total: Any = 0.0
    for _ in range(5):
        env._has_over = False  # rows that are over stand still
        obs, rewards, *_, infos = env.step(actions)
        total = total + rewards + infos["gamma"] + torch.nan_to_num(obs).sum(1)
    assert infos["failure"].tolist() == [3, 0, 4]
    found = slope(total, v_y)
    assert np.isfinite(found).all()
    assert found[1] != 0.0
    assert np.isfinite(slope(total, actions)).all()
    assert np.isfinite(slope(total, C_f))  # the sum over the rows


OFTEN = ("double-lane-change", "split-friction", "dakf-fig9", "dakf-fig6")
ALL = [
    pytest.param(each, marks=() if each in OFTEN else pytest.mark.long)
    for each, scenario in SCENARIOS.items()
    if scenario.steering not in ("trace", "wander")
]


@pytest.mark.parametrize("scenario", ALL)
def test_gradients_are_numbers_in_every_scenario_and_at_a_standstill(scenario: str) -> None:
    env = made(2, scenario=scenario, control_period=4)
    state = {"v_x": leaf(5.0, 0.0), "v_y": leaf(0.0, 0.0), "gamma": leaf(0.0, 0.0)}
    parameters = {"friction": leaf(0.8, 0.8), "rear_stiffness": leaf(2e4, 2e4)}
    env.reset(seed=0, options={"state": state, "parameters": parameters})
    actions = torch.zeros(2, 1, dtype=torch.float64, requires_grad=True)
    for _ in range(2):
        obs, rewards, *_ = env.step(actions)
    for inputs in (actions, *state.values(), *parameters.values()):
        assert np.isfinite(slope(obs.sum(1) + rewards, inputs)).all()


def test_at_a_limit_there_is_nothing_to_gain() -> None:
    env = made(3)
    env.reset(seed=0)
    actions = torch.tensor([[0.5], [1.0], [1.5]], dtype=torch.float64, requires_grad=True)
    env.step(actions)
    within, *beyond = np.ravel(slope(env.motion[:, 2], actions))
    assert within > 0.0
    assert beyond == [0.0, 0.0]


def test_a_snapshot_has_the_numbers_and_no_graph() -> None:
    """The compiled engine goes on from it."""
    env, other = made(), batch(FUSION, 2, control_period=3)
    parameters = {"rear_track": leaf(1.0, 1.2), "sprung_mass": leaf(300.0, 310.0)}
    env.reset(seed=0, options={"parameters": parameters, "state": {"psi": leaf(0.1, 0.2)}})
    env.step(torch.zeros(2, 1))
    other.set_state(env.get_state())
    for each in (env, other):
        each.step(np.full((2, 1), 0.3, np.float32))
    assert largest_error(env.get_state(), other.get_state()) < EXACT
    env.set_state(other.get_state())
    assert not env.motion.requires_grad


BAD: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"parameters": {"C_f": leaf(2e4)}}, ValueError, "unknown parameter 'C_f'; known: mass,"),
    ({"parameters": {"motor_lag": leaf(0.1)}}, ValueError, "unknown parameter 'motor_lag'"),
    ({"parameters": {"mass": leaf(1.0, 2.0, 3.0)}}, ValueError, r"mass: a tensor \(\) or \(2,\)"),
    ({"parameters": {"mass": leaf(4e2, -1.0)}}, ValueError, "Vehicle.mass: -1.0 kg is not positi"),
    ({"parameters": {"mass": leaf(4e2, np.nan)}}, ValueError, "Vehicle.mass: nan kg is not"),
    ({"parameters": {"mass": "heavy"}}, ValueError, "mass 'heavy' is no finite number"),
    ({"parameters": [1.0]}, TypeError, "reset option parameters is a mapping"),
    ({"state": {"v_y": torch.zeros(2, 1)}}, ValueError, r"v_y: a tensor \(\) or \(2,\), got"),
    ({"state": {"beta": leaf(0.1)[0]}}, ValueError, "unknown state beta"),
    ({"state": {"v_y": torch.zeros(2, device="meta")}}, ValueError, "v_y is on meta, the env on"),
]
LATER = {"scenario": {"base": "random-steering", "gps_latency": (0.1, 0.9)}}


@pytest.mark.parametrize(("options", "error", "message"), BAD, ids=str)
def test_bad_inputs_are_refused_and_nothing_is_reset(
    options: dict[str, Any], error: type[Exception], message: str
) -> None:
    env = made()
    env.reset(seed=0)
    before = env.motion
    with pytest.raises(error, match=message):
        env.reset(seed=1, options=options)
    assert torch.equal(env.motion, before)


def test_rows_that_are_not_reset_keep_their_graph_or_nothing_is_reset() -> None:
    env, v_y = made(), leaf(0.1, 0.2)
    env.reset(seed=0, options={"state": {"v_y": v_y}})
    env.step(torch.zeros(2, 1))
    before, mask = env.motion, np.array([False, True])
    for _ in range(2):  # the refused sensors are not remembered
        with pytest.raises(ValueError, match="more room than any before: reset all rows"):
            env.reset(options=LATER | {"reset_mask": mask})
        assert torch.equal(env.motion, before)
    env.reset(options={"reset_mask": mask})
    assert slope(env.motion[0], v_y) != [0.0, 0.0]
    env.reset(options=LATER)


def test_a_body_that_no_parameters_could_hold_up_is_refused() -> None:
    """Though each of them could by itself."""
    env = made(scenario="coms-slalom")
    inertia, mass = {"roll_inertia": leaf(31.0, 31.0)}, {"mass": leaf(380.0, 340.0)}
    for parameters in (inertia, mass):
        env.reset(seed=0, options={"parameters": parameters})
    with pytest.raises(ValueError, match=r"roll_inertia: 31\.0 .* of 340\.0 kg has more than 32"):
        env.reset(options={"parameters": inertia | mass})


def test_parameters_need_gradients() -> None:
    env = make_device_env(FUSION, 2)
    with pytest.raises(ValueError, match="unknown reset option parameters"):
        env.reset(options={"parameters": {"mass": leaf(400.0, 400.0)}})
