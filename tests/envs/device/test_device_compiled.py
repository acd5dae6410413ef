"""The gradient engine by `torch.compile`: the same steps, compiled once."""

import pytest

torch = pytest.importorskip("torch")

from sideslip.envs.device import make_device_env  # noqa: E402

from .moments import FUSION, UNEVEN, agrees, episodes  # noqa: E402


@pytest.mark.long
def test_compiled_ticks_are_the_same_and_compiled_once() -> None:
    scenario = {"base": "random-steering", "duration": 0.3}
    moments = episodes(FUSION, 40, scenario=scenario)
    env = agrees(FUSION, moments, scenario=scenario, compile=True)
    with torch.compiler.set_stance("fail_on_recompile"):
        for _ in range(3):
            env.step(torch.zeros(env.num_envs, 1))


@pytest.mark.long
def test_more_environments_are_compiled_than_torch_allows_for_one_text(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By dynamo alone: what refuses a ninth, here a third, comes before any machine code."""
    monkeypatch.setattr("torch._dynamo.config.recompile_limit", 2)
    whole = torch.compile
    monkeypatch.setattr(
        torch,
        "compile",
        lambda f, fullgraph, options: whole(f, fullgraph=fullgraph, backend="eager"),
    )
    for period in range(1, 4):
        env = make_device_env(UNEVEN, 2, control_period=period, compile=True)
        env.reset(seed=0)
        assert env.step(torch.zeros(2, 1))[0].shape == (2, len(env.layout))
