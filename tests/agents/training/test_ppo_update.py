"""PPO's update by NumPy is stable-baselines3's, parameters and log; other forms go by torch."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

torch = pytest.importorskip("torch")
stable_baselines3 = pytest.importorskip("stable_baselines3")

from stable_baselines3.common.logger import Logger  # noqa: E402
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor  # noqa: E402

from sideslip.agents.training.algorithms import make_model, settings_of  # noqa: E402
from sideslip.agents.training.ppo.update import PPO, parts_of  # noqa: E402
from sideslip.agents.vec_env import make_vec_env  # noqa: E402

ENV, STEERED = "sideslip/YawVision-v0", "sideslip/AfsYawFusion-v0"
FEW: dict[str, Any] = {"n_steps": 24, "batch_size": 32, "n_epochs": 3, "learning_rate": 1e-3}
FORMS: list[dict[str, Any]] = [
    {},
    {"env": STEERED, "policy_kwargs": {"activation_fn": torch.nn.SiLU, "net_arch": [24]}},
    {"policy_kwargs": {"activation_fn": torch.nn.ReLU, "net_arch": {"pi": [8, 9], "vf": [7]}}},
    {"ent_coef": 0.1, "vf_coef": 0.2, "max_grad_norm": 0.01, "clip_range": 0.01},
    {"normalize_advantage": False, "batch_size": 40},  # the last minibatch is smaller
]


def learned(kind: Any, rounds: int = 2, **form: Any) -> tuple[Any, list[dict[str, Any]]]:
    """A model after so many rollouts, each driven as the first model's, and what it logged."""
    options = FEW | form
    env = make_vec_env(options.pop("env", ENV), 4, seed=0)
    model, logs = kind("MlpPolicy", env, seed=3, device="cpu", **options), list[dict[str, Any]]()
    model.set_logger(Logger(None, []))
    rng = np.random.default_rng(0)
    for _ in range(rounds):
        buffer = model.rollout_buffer
        buffer.reset()
        for name in ("observations", "actions", "advantages", "returns", "values"):
            shape = getattr(buffer, name).shape
            getattr(buffer, name)[:] = rng.normal(scale=0.5, size=shape)
        flat = buffer.swap_and_flatten
        with torch.no_grad():
            tensors = (
                torch.as_tensor(flat(each)) for each in (buffer.observations, buffer.actions)
            )
            _, log_probs, _ = model.policy.evaluate_actions(*tensors)
        moved = log_probs.numpy().reshape(4, -1).T + rng.normal(scale=0.1, size=(24, 4))
        buffer.log_probs[:] = moved
        buffer.full = True
        np.random.seed(7)  # which draws the minibatches
        model.train()
        logs.append(dict(model.logger.name_to_value))
    return model, logs


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_it_is_stable_baselines3s_update(form: dict[str, Any], monkeypatch: Any) -> None:
    wanted, theirs = learned(stable_baselines3.PPO, **form)
    monkeypatch.setattr(stable_baselines3.PPO, "train", lambda self: pytest.fail("torch's"))
    found, ours = learned(PPO, **form)
    start, _ = learned(PPO, rounds=0, **form)
    before, pairs = start.policy.state_dict(), wanted.policy.state_dict()
    for name, value in found.policy.state_dict().items():
        np.testing.assert_allclose(value, pairs[name], rtol=0.0, atol=2e-6, err_msg=name)
        assert (value != before[name]).any(), name
    one, other = (each.policy.optimizer.state_dict() for each in (found, wanted))
    assert (
        one["param_groups"] == other["param_groups"]
        and one["state"].keys() == other["state"].keys()
    )
    for k, state in other["state"].items():
        for name, value in state.items():
            mine = one["state"][k][name]
            assert mine.dtype == value.dtype and mine.shape == value.shape
            np.testing.assert_allclose(mine, value, rtol=1e-3, atol=1e-6, err_msg=name)
    for mine, logged in zip(ours, theirs, strict=True):
        assert mine.keys() == logged.keys()
        for name, value in logged.items():
            assert mine[name] == pytest.approx(value, rel=1e-3, abs=1e-5), name


class Trained(BaseFeaturesExtractor):
    """A first layer that learns, too."""

    def __init__(self, space: gym.spaces.Box) -> None:
        super().__init__(space, 5)
        self.layer = torch.nn.Linear(space.shape[0], 5)

    def forward(self, observations: Any) -> Any:
        return self.layer(observations)


@pytest.mark.parametrize(
    "form",
    [
        {"target_kl": 1.0},
        {"clip_range_vf": 0.2},
        {"use_sde": True},
        {"policy_kwargs": {"net_arch": []}},
        {"policy_kwargs": {"activation_fn": torch.nn.ELU}},
        {"policy_kwargs": {"features_extractor_class": Trained}},
        {"policy_kwargs": {"share_features_extractor": False}},
        {"policy_kwargs": {"optimizer_class": torch.optim.AdamW}},
        {"policy_kwargs": {"optimizer_kwargs": {"weight_decay": 0.1}}},
    ],
    ids=str,
)
def test_other_forms_go_by_torch(form: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    went: list[Any] = []
    monkeypatch.setattr(stable_baselines3.PPO, "train", lambda self: went.append(self))
    env = make_vec_env(ENV, 4, seed=0)
    model = PPO("MlpPolicy", env, seed=3, device="cpu", **(FEW | form))
    model.train()
    assert went == [model]


@pytest.mark.parametrize("entry", [ENV, "begun", "begun-traces"])
def test_our_settings_have_the_form(entry: str) -> None:
    """Those of trainings from the start, and of those that go on from a policy."""
    env = make_vec_env(ENV, 4, seed=0)
    (k,) = env.observation_space.shape or ()
    scaling = [0.0] * k, [1.0] * k, 8.0, np.eye(k).tolist()
    model: Any = make_model("ppo", settings_of("ppo", entry), env, 0.01, scaling, 0, device="cpu")
    assert isinstance(model, PPO) and parts_of(model.policy) is not None
