"""Zips of stable-baselines3: driven as its own `predict` drives them, or refused by name."""

import functools
import importlib
import json
import pickle
import sys
import zipfile
from copy import deepcopy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import sideslip
from sideslip.agents.env_info import get_env_facts
from sideslip.agents.learned.policy import load_policy
from sideslip.agents.training.export import convert_sb3_policy, export_zip

sb3 = pytest.importorskip("stable_baselines3")
contrib = pytest.importorskip("sb3_contrib")
import torch  # noqa: E402
from stable_baselines3.common import envs  # noqa: E402
from stable_baselines3.common.policies import ActorCriticPolicy  # noqa: E402
from stable_baselines3.common.torch_layers import FlattenExtractor  # noqa: E402
from stable_baselines3.common.vec_env import VecEnvWrapper, VecFrameStack, VecNormalize  # noqa: E402

from sideslip.agents.vec_env import get_scales, make_vec_env  # noqa: E402

torch.set_num_threads(1)
ID, GUST = "sideslip/YawVision-v0", {"base": "gust", "duration": 0.3}
SMALL: dict[str, Any] = {"net_arch": [8]}
OFF: dict[str, Any] = {"buffer_size": 10}
LSTM = SMALL | {"lstm_hidden_size": 6}
APART = {"net_arch": {"pi": [8, 4], "vf": [3]}, "share_features_extractor": False}
SQUASHED = SMALL | {"squash_output": True}
MODELS: dict[str, tuple[Any, Any]] = {
    "PPO": (sb3.PPO, {}),
    "PPO, gSDE": (sb3.PPO, {"use_sde": True}),
    "PPO, squashed gSDE": (sb3.PPO, {"use_sde": True, "policy_kwargs": SQUASHED}),
    "PPO, two extractors": (sb3.PPO, {"policy_kwargs": APART}),
    "A2C": (sb3.A2C, {}),
    "SAC": (sb3.SAC, OFF),
    "TD3": (sb3.TD3, OFF),
    "TQC": (contrib.TQC, OFF),
    "RecurrentPPO": (contrib.RecurrentPPO, {"policy_kwargs": LSTM}),
    "RecurrentPPO, two layers": (
        contrib.RecurrentPPO,
        {"policy_kwargs": LSTM | {"n_lstm_layers": 2}},
    ),
} | {
    f"PPO, {each.__name__}": (sb3.PPO, {"policy_kwargs": SMALL | {"activation_fn": each}})
    for each in (torch.nn.ReLU, torch.nn.ELU, torch.nn.LeakyReLU, torch.nn.SiLU)
}


def bridged(rows: int = 3, env_id: str = ID, scaled: bool = False) -> Any:
    return make_vec_env(env_id, rows, seed=0, env_kwargs={"scenario": GUST}, scaled=scaled)


def normalised(env: Any) -> VecNormalize:
    """With the statistics of a hundred steps."""
    normaliser = VecNormalize(env)
    normaliser.reset()
    rng = np.random.default_rng(0)
    for _ in range(100):
        normaliser.step(rng.uniform(-1.0, 1.0, (env.num_envs, *env.action_space.shape)))
    normaliser.training = False
    return normaliser


def made(kind: Any, policy: Any, env: Any, **options: Any) -> Any:
    """Weights as large as training makes them: a fresh actor hardly acts at all."""
    options = deepcopy({"policy_kwargs": SMALL} | options)  # stable-baselines3 writes into them
    model = kind(policy, env, device="cpu", seed=0, **options)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for weight in model.policy.parameters():
            weight.add_(0.2 * torch.randn(weight.shape, generator=generator))
    return model


def difference(model: Any, zipped: Path, seen: Any, raw: Any) -> float:
    """The largest between the model's actions and the zip's over 80 steps, 2 episodes a row.

    seen: what the model was trained on. raw: the env's own observations after each step.
    """
    agent = sideslip.make_agent(str(zipped), bridged(), trust=True)
    obs, start = seen.reset(), np.ones(3, np.bool_)
    theirs_state: Any = None
    state: Any = None
    worst, acted = 0.0, []
    for _ in range(80):
        theirs, theirs_state = model.predict(obs, theirs_state, start, deterministic=True)
        ours, state = agent.predict(raw(), state, start)
        worst = max(worst, float(np.abs(theirs - ours).max()))
        acted.append(theirs)
        obs, _, start, _ = seen.step(theirs)
    assert np.ptp(acted) > 0.1 and np.mean(np.abs(acted) < 1.0) > 0.5
    return worst


@pytest.mark.parametrize("name", MODELS)
def test_a_zip_drives_as_its_model_predicts(name: str, tmp_path: Path) -> None:
    kind, options = MODELS[name]
    policy = "MlpLstmPolicy" if kind is contrib.RecurrentPPO else "MlpPolicy"
    env = normalised(bridged())
    model = made(kind, policy, env, **options)
    model.save(tmp_path / "mine.zip")
    env.save(str(tmp_path / "mine.pkl"))
    assert difference(model, tmp_path / "mine.zip", env, env.get_original_obs) < 1e-6


@pytest.mark.parametrize("inside", [True, False], ids=["frames scaled", "stack scaled"])
def test_a_stack_of_frames_is_recognised(tmp_path: Path, inside: bool) -> None:
    if inside:
        normaliser = normalised(bridged())
        env: Any = VecFrameStack(normaliser, 3)
    else:
        env = normaliser = normalised(VecFrameStack(bridged(), 3))
    model = made(sb3.PPO, "MlpPolicy", env)
    model.save(tmp_path / "mine.zip")
    normaliser.save(str(tmp_path / "vecnormalize.pkl"))

    def newest() -> Any:
        obs: Any = normaliser.get_original_obs()
        return obs[:, -22:]

    assert difference(model, tmp_path / "mine.zip", env, newest) < 1e-6


class Keep(VecEnvWrapper):
    """Keeps the newest observation."""

    newest: Any

    def reset(self) -> Any:
        self.newest = self.venv.reset()
        return self.newest

    def step_wait(self) -> Any:
        outcome = self.venv.step_wait()
        self.newest = outcome[0]
        return outcome


@pytest.mark.parametrize("around", [None, "normalised", "stacked"])
def test_a_zip_of_scaled_observations_reads_plain_ones(around: Any, tmp_path: Path) -> None:
    """Its scales are found by the bounds of its space, with no file beside it."""
    keep, scales = Keep(bridged(scaled=True)), get_scales(get_env_facts(bridged()).layout)
    env: Any = normalised(keep) if around == "normalised" else keep
    env = VecFrameStack(keep, 3) if around == "stacked" else env
    model = made(sb3.PPO, "MlpPolicy", env)
    model.save(tmp_path / "mine.zip")
    if around == "normalised":
        env.save(str(tmp_path / "mine.pkl"))
    assert difference(model, tmp_path / "mine.zip", env, lambda: keep.newest * scales) < 1e-5


@pytest.fixture(scope="module")
def zipped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("zips") / "mine.zip"
    made(contrib.RecurrentPPO, "MlpLstmPolicy", bridged(), policy_kwargs=LSTM).save(path)
    return path


def test_an_export_is_the_zip_and_needs_no_trust(zipped: Path, tmp_path: Path) -> None:
    target = tmp_path / "mine.safetensors"
    export_zip(zipped, target, ID, {"scenario": "gust"}, trust=True, command="sideslip export")
    card = load_policy(target).card
    assert card.env_id == ID and card.env_options == {"scenario": "gust"}
    assert "RecurrentActorCriticPolicy" in card.algorithm and card.command == "sideslip export"
    env = gym.make(ID)
    drives = [
        sideslip.rollout(env, sideslip.make_agent(str(path), env, trust=trusted))
        for path, trusted in ((zipped, True), (target, False))
    ]
    assert np.array_equal(drives[0]["action"], drives[1]["action"])
    assert np.ptp(drives[0]["action"]) > 0.0


class Fires:
    """Unpickled, it writes a file."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> Any:
        return Path.write_text, (self.trace, "ran")


def test_an_export_has_the_estimators_options_of_its_card(tmp_path: Path) -> None:
    options = {"outputs": ["beta", "psi"]}
    env = make_vec_env(ID, estimator={"estimator": "exact-kf", **options})
    made(sb3.PPO, "MlpPolicy", env).save(zipped := tmp_path / "model.zip")
    about: dict[str, Any] = {"estimator": "exact-kf", "estimator_options": options}
    policy = export_zip(zipped, tmp_path / "model.safetensors", ID, trust=True, **about)
    assert ("psi_hat", "rad") in policy.card.observation


def test_nothing_is_read_without_trust(zipped: Path, tmp_path: Path) -> None:
    import base64

    trace, path = tmp_path / "trace", tmp_path / "mine.zip"
    fires = base64.b64encode(pickle.dumps(Fires(trace))).decode()
    with zipfile.ZipFile(zipped) as source, zipfile.ZipFile(path, "w") as target:
        for name in source.namelist():
            target.writestr(name, source.read(name))
        data = json.loads(source.read("data"))
    data["policy_class"] = {":type:": "type", ":serialized:": fires}
    with zipfile.ZipFile(path, "a") as target, pytest.warns(UserWarning, match="Duplicate"):
        target.writestr("data", json.dumps(data))
    env = gym.make(ID)
    said = r"runs whatever code .*--trust \(trust=True\); `sideslip export .*mine.zip --trust`"
    with pytest.raises(PermissionError, match=said):
        sideslip.make_agent(str(path), env)
    assert not trace.exists()
    with pytest.raises(ValueError, match=r"mine\.zip: its policy is of no class, but 3"):
        sideslip.make_agent(str(path), env, trust=True)
    assert trace.exists()


def test_a_file_that_is_no_policy_is_refused_before_trust(zipped: Path, tmp_path: Path) -> None:
    env, path = gym.make(ID), tmp_path / "other.zip"
    with pytest.raises(FileNotFoundError, match="no such file"):
        sideslip.make_agent(str(path), env)
    for length in (0, 100, zipped.stat().st_size - 30):
        path.write_bytes(zipped.read_bytes()[:length])
        with pytest.raises(ValueError, match=r"other\.zip is no zip.*, or is cut short"):
            sideslip.make_agent(str(path), env)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", "{}")
    with pytest.raises(ValueError, match=r"no zip of stable-baselines3.* holds no policy\.pth"):
        sideslip.make_agent(str(path), env)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("policy.pth", "weights")
    with pytest.raises(ValueError, match=r"other\.zip cannot be read"):
        sideslip.make_agent(str(path), env, trust=True)


class Mine(ActorCriticPolicy):
    """Computes what it likes."""


class Shy(FlattenExtractor):
    """So does this."""


def offered(
    kind: Any = sb3.PPO, policy: Any = "MlpPolicy", env: Any = bridged, **options: Any
) -> tuple[Any, Any, Any, dict[str, Any]]:
    return kind, policy, env, {"policy_kwargs": SMALL} | options


IMAGES = functools.partial(envs.FakeImageEnv, discrete=False)
SEVERAL = functools.partial(envs.SimpleMultiObsEnv, discrete_actions=False)
FUSION = functools.partial(bridged, env_id="sideslip/YawFusion-v0")
BOX = functools.partial(envs.IdentityEnvBox, -1, 1)
HALF = functools.partial(torch.nn.ELU, 0.5)
REFUSED: dict[str, tuple[tuple[Any, Any, Any, dict[str, Any]], str]] = {
    "CNN": (
        offered(policy="CnnPolicy", env=IMAGES, policy_kwargs={}, n_steps=8),
        "the actor of .*ActorCriticCnnPolicy is not known; known: ActorCriticPolicy, SACPolicy",
    ),
    "several inputs": (
        offered(policy="MultiInputPolicy", env=SEVERAL, policy_kwargs={}, n_steps=8),
        "actor of .*MultiInputActorCriticPolicy is not known",
    ),
    "own policy": (offered(policy=Mine), "the actor of .*Mine is not known"),
    "own extractor": (
        offered(policy_kwargs={"features_extractor_class": Shy}),
        "the observation goes through Shy",
    ),
    "DQN": (offered(sb3.DQN, env=lambda: "CartPole-v1", **OFF), "DQNPolicy is not known"),
    "gSDE": (offered(sb3.SAC, **OFF, use_sde=True), "gSDE.* clips the mean"),
    "GELU": (offered(policy_kwargs={"activation_fn": torch.nn.GELU}), "layer GELU"),
    "activation": (
        offered(policy_kwargs={"activation_fn": HALF}),
        r"layer ELU\(alpha=0.5\) is not known; known: linear, tanh, relu, elu",
    ),
    "both ways": (
        offered(
            contrib.RecurrentPPO,
            "MlpLstmPolicy",
            policy_kwargs=LSTM | {"lstm_kwargs": {"batch_first": True}},
        ),
        "recurrent layers with further arguments",
    ),
    "another env": (
        offered(env=FUSION),
        "30 numbers; the observation here has 22: gyro, ",
    ),
    "other bounds": (offered(env=BOX), "bounds, 1 numbers; the observation here has 22"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_exported_is_refused_by_name(name: str, tmp_path: Path) -> None:
    (kind, policy, env, options), said = REFUSED[name]
    model = kind(policy, env(), device="cpu", **deepcopy(options))
    model.save(tmp_path / "mine.zip")
    with pytest.raises(ValueError, match=said):
        sideslip.make_agent(str(tmp_path / "mine.zip"), gym.make(ID), trust=True)


def test_another_normaliser_is_refused(zipped: Path, tmp_path: Path) -> None:
    make = functools.partial(sideslip.make_agent, str(zipped), gym.make(ID), trust=True)
    path = tmp_path / "other.pkl"
    with pytest.raises(FileNotFoundError, match="no such file"):
        make(normalise=path)
    for content, said in (
        (b"nonsense", "cannot be read as a VecNormalize"),
        (pickle.dumps({}), "holds a dict, not a VecNormalize"),
        (pickle.dumps(VecNormalize(bridged(1, "sideslip/YawGps-v0"))), "of another observation"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=said):
            make(normalise=path)


@pytest.mark.parametrize("name", ["PPO", "PPO, linear", "PPO, ReLU", "A2C", "SAC", "TD3"])
def test_it_is_torchs_function_where_torch_is_in_double_precision(name: str) -> None:
    """For observations of any size, where single precision rounds more than 1e-6 away."""
    linear: dict[str, Any] = {"PPO, linear": (sb3.PPO, {"policy_kwargs": {"net_arch": []}})}
    kind, options = (MODELS | linear)[name]
    model = made(kind, "MlpPolicy", bridged(), **options)
    x, policy = np.random.default_rng(0).normal(size=(200, 22)) * 10.0, model.policy
    if kind in (sb3.PPO, sb3.A2C):
        layers = [policy.mlp_extractor.policy_net, policy.action_net]
    elif kind is sb3.SAC:
        layers = [policy.actor.latent_pi, policy.actor.mu, torch.nn.Tanh()]
    else:
        layers = [policy.actor.mu]
    with torch.no_grad():
        theirs = torch.nn.Sequential(*layers).double()(torch.from_numpy(x)).numpy()
    ours = convert_sb3_policy(model)(x)
    assert np.abs(ours - theirs).max() < 1e-12 * max(1.0, np.abs(theirs).max())


def test_what_never_varied_is_not_read() -> None:
    env = normalised(bridged())
    network = convert_sb3_policy(made(sb3.PPO, "MlpPolicy", env), env)
    names = [entry.name for entry in gym.make(ID).get_wrapper_attr("layout")]
    unread = {name for name, scale in zip(names, network.scale, strict=True) if scale == 0.0}
    assert unread == {"beta_ref", "gamma_ref", "steer", "steer_command"}  # a gust, zero slip
    assert network.clip == env.clip_obs


def test_another_range_of_actions_is_named() -> None:
    wide = made(sb3.PPO, "MlpPolicy", bridged())
    wide.policy.action_space = gym.spaces.Box(-2.0, 2.0, (1,), np.float32)
    with pytest.raises(ValueError, match=r"within \[-1, 1\]"):
        convert_sb3_policy(wide)


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.vec_env", None)
    for name in ("vec_env", "training.export"):
        monkeypatch.delitem(sys.modules, f"sideslip.agents.{name}")
    with pytest.raises(ModuleNotFoundError, match=r"sideslip\[train\]"):
        importlib.import_module("sideslip.agents.training.export")
