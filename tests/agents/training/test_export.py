"""The actor of a stable-baselines3 model, run without torch: the same actions to 1e-6."""

import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import sideslip  # noqa: F401  registers the ids
from sideslip.agents.training.export import convert_sb3_policy

stable_baselines3 = pytest.importorskip("stable_baselines3")
import torch  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize  # noqa: E402

ID = "sideslip/YawVision-v0"


def normalised(**options: Any) -> VecNormalize:
    """Statistics of a few hundred steps; beta_ref and gamma_ref are always zero in this id."""
    env = VecNormalize(DummyVecEnv([lambda: gym.make(ID)] * 2), **options)
    env.seed(0)
    env.reset()
    rng = np.random.default_rng(0)
    for _ in range(300):
        env.step(rng.uniform(-1.0, 1.0, (2, 1)))
    env.training = False
    return env


def observations(env: VecNormalize) -> np.ndarray:
    """Raw ones of a drive."""
    rng = np.random.default_rng(1)
    env.reset()
    seen: list[Any] = [env.get_original_obs()]
    for _ in range(200):
        env.step(rng.uniform(-1.0, 1.0, (2, 1)))
        seen.append(env.get_original_obs())
    return np.concatenate(seen)


def stirred(model: Any) -> Any:
    """Weights as large as training makes them: a fresh actor hardly acts at all."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for weight in model.policy.parameters():
            weight.add_(0.1 * torch.randn(weight.shape, generator=generator))
    return model


MODELS: dict[str, tuple[str, dict[str, Any]]] = {
    "ppo": ("PPO", {}),
    "ppo, relu": ("PPO", {"policy_kwargs": {"activation_fn": torch.nn.ReLU}}),
    "ppo, one layer": ("PPO", {"policy_kwargs": {"net_arch": [32]}}),
    "ppo, linear": ("PPO", {"policy_kwargs": {"net_arch": []}}),
    "a2c": ("A2C", {}),
    "sac": ("SAC", {"buffer_size": 10}),
    "td3": ("TD3", {"buffer_size": 10}),
}


def made(name: str, env: VecNormalize) -> Any:
    kind, options = MODELS[name]
    algorithm = getattr(stable_baselines3, kind)
    return stirred(algorithm("MlpPolicy", env, device="cpu", seed=0, **options))


@pytest.mark.parametrize("name", MODELS)
def test_actions_of_a_drive_equal_torchs(name: str) -> None:
    env = normalised()
    model = made(name, env)
    x = observations(env)
    theirs, _ = model.predict(env.normalize_obs(x), deterministic=True)
    ours = np.clip(convert_sb3_policy(model, env)(x.astype(np.float64)), -1.0, 1.0)
    assert (np.abs(theirs) < 1.0).sum() > 300 and np.ptp(theirs) > 0.1  # few are clipped
    assert np.abs(ours - theirs).max() < 1e-6


@pytest.mark.parametrize("name", MODELS)
def test_it_is_torchs_function_where_torch_is_in_double_precision(name: str) -> None:
    """For observations of any size, where single precision rounds more than 1e-6 away."""
    env = normalised(norm_obs=False)
    model = made(name, env)
    x = np.random.default_rng(0).normal(size=(200, 22)) * 10.0
    ours = convert_sb3_policy(model, env)(x)
    policy = model.policy
    if name.startswith(("ppo", "a2c")):
        layers = [policy.mlp_extractor.policy_net, policy.action_net]
    elif name == "sac":
        layers = [policy.actor.latent_pi, policy.actor.mu, torch.nn.Tanh()]
    else:
        layers = [policy.actor.mu]
    with torch.no_grad():
        theirs = torch.nn.Sequential(*layers).double()(torch.from_numpy(x)).numpy()
    assert np.abs(ours - theirs).max() < 1e-12 * max(1.0, np.abs(theirs).max())


def test_what_never_varied_is_not_read() -> None:
    env = normalised()
    network = convert_sb3_policy(stable_baselines3.PPO("MlpPolicy", env, device="cpu"), env)
    names = [entry.name for entry in gym.make(ID).get_wrapper_attr("layout")]
    unread = {name for name, scale in zip(names, network.scale, strict=True) if scale == 0.0}
    assert unread == {"beta_ref", "gamma_ref"}
    assert network.clip == env.clip_obs


def test_what_is_no_dense_actor_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    env = normalised()
    ppo = stable_baselines3.PPO
    cases: list[tuple[Any, Any, str]] = [
        (ppo("MlpPolicy", env, policy_kwargs={"activation_fn": torch.nn.GELU}), env, "layer GELU"),
        (
            stable_baselines3.DQN("MlpPolicy", "CartPole-v1", buffer_size=10),
            None,
            "DQNPolicy is not known",
        ),
    ]
    for model, normaliser, said in cases:
        with pytest.raises(ValueError, match=said):
            convert_sb3_policy(model, normaliser)
    other = VecNormalize(DummyVecEnv([lambda: gym.make("sideslip/YawFusion-v0")]))
    with pytest.raises(ValueError, match="of another observation"):
        convert_sb3_policy(ppo("MlpPolicy", env), other)
    wide = ppo("MlpPolicy", env)
    wide.policy.action_space = spaces.Box(-2.0, 2.0, (1,), np.float32)
    with pytest.raises(ValueError, match=r"within \[-1, 1\]"):
        convert_sb3_policy(wide, env)
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.torch_layers", None)
    with pytest.raises(ModuleNotFoundError, match=r"sideslip\[train\]"):
        convert_sb3_policy(wide, env)
