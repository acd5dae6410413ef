"""`DeviceVectorEnv(grad=True)`: its gradients are central differences, late sensors' too."""

from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from sideslip.envs.device import TensorVectorEnv, make_device_env  # noqa: E402
from sideslip.envs.numerics.torch_backend import GradientGate  # noqa: E402
from sideslip.envs.record import PACKET  # noqa: E402

from .moments import DRIVEN, FUSION  # noqa: E402

VISION = "sideslip/YawVision-v0"
DEVICES = ["cpu"] + ["cuda"] * torch.cuda.is_available()
STATE = {"v_x": (6.5, 1e-3), "v_y": (0.2, 1e-4), "gamma": (0.15, 1e-4), "psi": (0.02, 1e-4)}
STATE |= {"Y": (0.3, 1e-3), "y": (0.3, 1e-3), "phi": (0.01, 1e-4)}
PARAMETERS = {"front_stiffness": (21e3, 50.0), "rear_stiffness": (24e3, 50.0)}
PARAMETERS |= {"mass": (420.0, 0.1), "rear_track": (1.1, 1e-3), "friction": (0.8, 1e-4)}
ACTIONS = {"first": (0.3, 1e-4), "last": (-0.3, 1e-4)}
INPUTS = STATE | PARAMETERS | ACTIONS
"""Where each input stands, and by how much it is moved."""
STEPS = 7  # in the last of which the camera's second picture arrives


def drive(env: TensorVectorEnv, inputs: dict[str, Any]) -> Any:
    """A number of each row (N,) that all observations, rewards and infos of a drive enter.

    inputs: tensors (N,). "first" and "last" are the first action and the others.
    """
    state = {name: inputs[name] for name in STATE}
    options = {"state": state, "parameters": {name: inputs[name] for name in PARAMETERS}}
    obs, infos = env.reset(seed=[3] * env.num_envs, options=options)
    weights = np.random.default_rng(1).normal(size=(STEPS + 1, obs.shape[1]))
    shares = torch.as_tensor(weights, device=obs.device)
    total = obs @ shares[-1] + infos["beta"]
    width = env.single_action_space.shape[0]  # type: ignore[index]
    for k in range(STEPS):
        action = inputs["first" if k == 0 else "last"]
        obs, rewards, _, _, infos = env.step(action[:, None].expand(-1, width))
        total = total + obs @ shares[k] + 30.0 * rewards + infos["gamma"]
    return total


@pytest.mark.parametrize("shape", [(4,), (2, 4)])
def test_a_gate_lets_slopes_through_to_the_open_rows_alone(shape: tuple[int, ...]) -> None:
    """A row that is over gets zero, finite slopes or not; an open row all that is a number."""
    gate = GradientGate()
    value = torch.ones(shape, requires_grad=True)
    passed = gate(value)
    gate.open = torch.tensor([True, False, True, False])  # as late as the gradients
    (passed * torch.tensor([2.0, 3.0, torch.nan, torch.inf])).sum().backward()
    assert torch.equal(value.grad, torch.tensor([2.0, 0.0, 0.0, 0.0]).expand(shape))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", DRIVEN)
def test_gradients_are_central_differences_on_every_id(name: str, device: str) -> None:
    """To actions, the state at the start and parameters. Two rows of one drive move each input."""
    here: dict[str, Any] = {"dtype": torch.float64, "device": device}
    env = make_device_env(name, 1, grad=True, device=device)
    inputs = {key: torch.tensor([at], **here).requires_grad_() for key, (at, _) in INPUTS.items()}
    drive(env, inputs).sum().backward()
    many = make_device_env(name, 2 * len(INPUTS), grad=True, device=device)
    moved = {key: torch.full((many.num_envs,), at, **here) for key, (at, _) in INPUTS.items()}
    for i, (key, (_, by)) in enumerate(INPUTS.items()):
        moved[key][2 * i : 2 * i + 2] += torch.tensor([by, -by], **here)
    with torch.no_grad():
        numbers = drive(many, moved)
    for i, (key, (_, by)) in enumerate(INPUTS.items()):
        wanted = (numbers[2 * i] - numbers[2 * i + 1]).item() / (2.0 * by)
        assert inputs[key].grad.item() == pytest.approx(wanted, rel=1e-6, abs=1e-9), key
        assert abs(wanted) > 1e-7 or key in "Yy"  # a camera does not see Y, a GPS not y


def test_a_picture_knows_nothing_of_the_last_thirty_milliseconds() -> None:
    """One action a tick: what arrives at tick 63 was seen at 33."""
    env = make_device_env(VISION, 2, grad=True, control_period=1)
    env.reset(seed=1)
    actions = torch.full((63, 2, 1), 0.2, dtype=torch.float64, requires_grad=True)
    for action in actions:
        env.step(action)
    assert env.delivered.tolist() == [1, 1]
    packet = env.packets[:, 0]
    assert (packet[:, PACKET.captured] == 33.0).all()
    assert (packet[:, PACKET.arrived] == 63.0).all()
    for value in (PACKET.value, PACKET.value + 1):  # psi, y_l
        (slopes,) = torch.autograd.grad(packet[:, value].sum(), actions, retain_graph=True)
        assert (slopes[:33] != 0.0).all()
        assert (slopes[33:] == 0.0).all()
    (slopes,) = torch.autograd.grad(env.rows[:, -1, 0].sum(), actions)  # the gyro knows all
    assert (slopes != 0.0).all()


@pytest.mark.plain
@pytest.mark.parametrize("reference", ["zero-slip", "lagged"])
def test_numbers_are_those_without_gradients(reference: str) -> None:
    """In the same bits, and without `grad` there is no graph."""
    scenario = {"base": "random-steering", "duration": 0.05}
    arguments: dict[str, Any] = {"scenario": scenario, "reference": reference}
    one, other = (
        make_device_env(FUSION, 3, autoreset_mode="SameStep", grad=grad, **arguments)
        for grad in (False, True)
    )
    first, second = one.reset(seed=7)[0], other.reset(seed=7)[0]
    assert torch.equal(first, second.float())
    for step in range(7):
        actions = torch.full((3, 1), 0.1 * step, requires_grad=True)
        obs, *wanted, infos = one.step(actions)
        exact, *found, others = other.step(actions)
        assert torch.equal(obs, exact.float())
        assert exact.dtype == torch.float64
        for a, b in zip(wanted, found, strict=True):
            assert torch.equal(a, b)
        assert torch.equal(infos["beta"], others["beta"])
        assert torch.equal(one.motion, other.motion)
        assert torch.equal(one.rows[:, 0], other.rows[:, 0])  # what is there in any case
        results = (obs, wanted[0], infos["beta"], one.motion, *one.tensors()[0])
        assert not any(each.requires_grad for each in results)
        assert found[0].requires_grad
        assert exact.requires_grad == (step != 4)  # then an episode ends, and the next one begins
