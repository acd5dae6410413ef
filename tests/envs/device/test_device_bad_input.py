"""The gradient engine refuses bad input at the border, and steps nothing."""

from typing import Any

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

from .. import processes
from ..helpers import bits

torch = pytest.importorskip("torch")

from sideslip.envs.device import make_device_env  # noqa: E402

pytestmark = pytest.mark.plain

FUSION, AFS = "sideslip/YawFusion-v0", "sideslip/AfsYawFusion-v0"
FEW = {"num_envs": 2}
ARGUMENTS: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"num_envs": 0}, ValueError, "num_envs is at least 1, got 0"),
    ({"num_envs": 2.0}, TypeError, "num_envs is a number of environments, got 2.0"),
    ({"device": "gpu"}, ValueError, "unknown device 'gpu'; known: 'cpu', 'cuda'"),
    ({"device": "meta"}, ValueError, "unknown device 'meta'; known: 'cpu', 'cuda'"),
    ({"device": None}, ValueError, "unknown device None"),
    ({"device": "cuda:99"}, ValueError, "device 'cuda:99' is not there: torch .* finds cpu"),
    ({"engine": "opencl"}, ValueError, "unknown engine 'opencl'; known: torch, cuda"),
    ({"engine": "cuda", "device": "cpu"}, ValueError, "engine='cuda' runs on a CUDA device, got"),
    ({"dtype": "float16"}, ValueError, "dtype is 'float64' or 'float32', got 'float16'"),
    ({"dtype": torch.int64}, ValueError, "dtype is 'float64' or 'float32', got torch.int64"),
    ({"autoreset_mode": "Later"}, ValueError, "'Later'; known: 'NextStep'"),
    ({"scenario": "slalon"}, ValueError, "unknown scenario 'slalon'"),
    ({"estimator": "dakf"}, TypeError, "unknown argument 'estimator'"),
    ({"max_episode_steps": 3}, TypeError, "an env on a device has no max_episode_steps, got 3"),
    ({"render_mode": "rgb_array"}, TypeError, "has no render_mode, got 'rgb_array'"),
    ({"info": "ends"}, TypeError, "an env on a device has no info, got 'ends'"),
    ({"engine": "cuda", "compile": True}, ValueError, "compile is of engine='torch', not of"),
    ({"engine": "cuda", "grad": True}, ValueError, "grad is of engine='torch', not of 'cuda'"),
]


@pytest.mark.parametrize(("arguments", "error", "message"), ARGUMENTS, ids=str)
def test_arguments(arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make_device_env(FUSION, **(FEW | arguments))


def test_a_device_is_called_as_its_tensors_call_it() -> None:
    """Or their actions would be refused: those of cuda:0 where the env is on cuda."""
    env = make_device_env(FUSION, 2, device="cpu:0")
    assert env.device == torch.zeros(1, device=env.device).device == torch.device("cpu")
    env.reset(seed=0)
    env.step(torch.zeros(2, 1, device=env.device))


def test_without_a_compiler_nothing_is_compiled_and_a_warning_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.warns(RuntimeWarning, match="there is no 'no-such-compiler': ticks are not compi"):
        env = make_device_env(FUSION, 2, compile=True, control_period=1)
    env.reset(seed=0)
    env.step(torch.zeros(2, 1))


def test_an_id_that_has_no_such_environment() -> None:
    with pytest.raises(ValueError, match="sideslip/Outside-v0 has no environment on the device"):
        make_device_env("sideslip/Outside-v0", 2)


STILL = torch.zeros(3, 1)
BAD: list[tuple[Any, str]] = [
    (torch.zeros(3, 2), r"actions have shape \(3, 1\), got \(3, 2\); nothing was stepped"),
    (torch.zeros(2, 1), r"got \(2, 1\)"),
    (torch.zeros(3), r"got \(3,\)"),
    (torch.tensor([[0.0], [torch.nan], [0.0]]), r"of row 1 is not finite, \[nan\]; nothing was"),
    (torch.tensor([[torch.inf], [0.0], [torch.nan]]), r"rows 0, 2 \(2 of them\) is not finite"),
    (torch.zeros(3, 1, device="meta"), "actions are on meta, the env on cpu; nothing was stepped"),
    (np.zeros((2, 1)), r"actions have shape \(3, 1\), got 2 rows; nothing was stepped"),
    ([[0.0], [np.nan], [0.0]], "the action of row 1 is not finite"),
    (None, "got 0 rows"),
]


@pytest.mark.parametrize(("actions", "message"), BAD, ids=lambda told: str(told)[:40])
def test_bad_actions_are_refused_and_nothing_is_stepped(actions: Any, message: str) -> None:
    env = make_device_env(FUSION, 3, control_period=2)
    env.reset(seed=0)
    env.step(STILL)
    before = bits(env.get_state()["states"])
    with pytest.raises(ValueError, match=message):
        env.step(actions)
    assert bits(env.get_state()["states"]) == before
    env.step(STILL)


@pytest.mark.parametrize("bad", [torch.nan, -torch.inf])
def test_a_bad_action_may_fail_its_row_and_leaves_the_others_their_bits(bad: float) -> None:
    told: dict[str, Any] = {"control_period": 3, "on_bad_action": "fail"}
    env, beside = (make_device_env(AFS, 3, **told) for _ in range(2))
    actions = torch.full((3, 2), 0.5)
    for each in (env, beside):
        each.reset(seed=4)
        each.step(actions)
    wanted = beside.step(actions)
    actions[1, 0] = bad
    obs, rewards, terminated, truncated, infos = env.step(actions)
    assert terminated.tolist() == [False, True, False]
    assert not truncated.any()
    assert infos["failure"].tolist() == [0, 4, 0]
    assert not obs[1].any()
    assert rewards[1] == -100.0 * (10.0 - 0.003)
    for i in (0, 2):
        assert torch.equal(obs[i], wanted[0][i])
        assert torch.equal(env.motion[i], beside.motion[i])
    *_, infos = env.step(actions)  # that row starts anew, whatever its action
    assert infos["t"].tolist() == pytest.approx([0.009, 0.0, 0.009])
    obs, _, terminated, *_ = env.step(torch.zeros(3, 1))  # no row has two numbers
    assert terminated.all()


def test_a_plant_of_another_kind_is_refused_and_nothing_is_reset() -> None:
    env = make_device_env(FUSION, 2)
    env.reset(seed=0)
    before = env.get_state()
    with pytest.raises(ValueError, match=r"all rows have one kind of plant.*'dakf-fig6'"):
        env.reset(seed=1, options={"scenario": ["straight", "dakf-fig6"]})
    after = env.get_state()
    assert bits(before["states"]) == bits(after["states"])
    after["configs"] = make_device_env(FUSION, 2, scenario="dakf-fig6").get_state()["configs"]
    with pytest.raises(ValueError, match="one kind of plant"):
        env.set_state(after)
    with pytest.raises(ValueError, match="the snapshot has 3 rows"):
        env.set_state(make_device_env(FUSION, 3).get_state())
    with pytest.raises(TypeError, match=r"a snapshot is a mapping, got \(1, 2\)"):
        env.set_state((1, 2))


def test_what_was_not_started_or_is_over_waits_for_a_reset() -> None:
    env = make_device_env(
        FUSION, 2, autoreset_mode="Disabled", scenario={"base": "straight", "duration": 0.01}
    )
    with pytest.raises(ResetNeeded, match=r"call reset\(\) first"):
        env.step(torch.zeros(2, 1))
    with pytest.raises(ResetNeeded, match="reset all rows first"):
        env.reset(options={"reset_mask": np.array([True, False])})
    env.reset(seed=0)
    assert env.step(torch.zeros(2, 1))[3].all()
    with pytest.raises(ResetNeeded, match=r"over in rows 0, 1 \(2 of them\): call reset"):
        env.step(torch.zeros(2, 1))
    env.reset(options={"reset_mask": torch.tensor([True, False])})
    with pytest.raises(ResetNeeded, match="over in row 1: call reset"):
        env.step(torch.zeros(2, 1))


def test_torch_is_loaded_by_the_device_engine_alone() -> None:
    code = "import sys, sideslip.envs, sideslip.agents; print('torch' in sys.modules)"
    assert processes.finish(processes.start(code, {}))[0] == ["False"]


def test_without_torch_the_extra_is_named() -> None:
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "try:\n    import sideslip.envs.device\n"
        "except ModuleNotFoundError as error:\n    print(error)"
    )
    (line,), _ = processes.finish(processes.start(code, {}))
    assert "the device engine needs torch: pip install 'sideslip[train]'" in line
