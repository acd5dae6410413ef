"""Every algorithm trains, goes on, is exported and stops at NaN; settings are checked."""

import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")
import torch

from sideslip.agents.learned.policy import PolicyController, load_policy
from sideslip.agents.training import trainer
from sideslip.agents.training.callbacks import (
    BEST,
    CHECKPOINT,
    POLICY,
    EvalCallback,
    RunOptions,
    read_training,
)
from sideslip.agents.training.config import (
    ALGORITHMS,
    HYPERPARAMS,
    INITIAL_ENTRY,
    TrainingTask,
    _check_settings,
    _read_settings,
    get_algorithm,
)

SMALL: dict[str, Any] = {"n_steps": 16, "learning_starts": 64, "buffer_size": 4096}
ROLLOUT, VISION = 128, "sideslip/YawVision-v0"
EACH = RunOptions(eval_freq=ROLLOUT)


def tiny(algo: str) -> TrainingTask:
    """Rollouts of 128 steps or fewer that divide them, of few environments, and small buffers."""
    settings, n_envs = _read_settings(algo, VISION), 8
    settings |= {name: value for name, value in SMALL.items() if name in settings}
    settings |= {"train_freq": 16, "gradient_steps": 4} if "train_freq" in settings else {}
    scenario: dict[str, Any] = {"scenario": {"base": "sine-with-dwell", "duration": 0.5}}
    if "compile" in settings:  # on tensors a tick costs a thousand small operations
        settings |= {"compile": False, "n_steps": 4}
        scenario["control_period"], n_envs = 2, 32
    return TrainingTask(VISION, algo, "", scenario, 3, n_envs, settings=settings, n_eval_envs=4)


def tensors(model: Any) -> dict[str, Any]:
    """Every tensor that the training goes on with."""
    found = {name: getattr(model, name) for name in model._get_torch_save_params()[1]}
    for part, state in model.get_parameters().items():
        if "state" in state and "param_groups" in state:
            for i, each in state["state"].items():
                found |= {f"{part} {i} {key}": value for key, value in each.items()}
        else:
            found |= {f"{part} {name}": value for name, value in state.items()}
    return found


@pytest.fixture(scope="module", params=list(ALGORITHMS))
def trained(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """(task, folder, result) of two rollouts."""
    task, folder = tiny(request.param), tmp_path_factory.mktemp(request.param)
    return task, folder, trainer.Trainer(task, 2 * ROLLOUT, folder, run_options=EACH).train()


def test_it_goes_on_where_the_checkpoint_is(trained: Any) -> None:
    """Weights, the optimiser's moments, the step size, the count, the evaluations."""
    task, folder, first = trained
    again = trainer.Trainer(
        task, 2 * ROLLOUT, folder, resume=True
    ).train()  # there is nothing to do
    assert again.evaluations == first.evaluations
    one, other = tensors(first.model), tensors(again.model)
    assert one.keys() == other.keys() and len(one) > 30
    assert all(torch.equal(one[name], other[name]) for name in one)
    assert any("log_ent_coef" in name for name in one) == (task.algo in ("sac", "tqc"))
    before = {name: value.clone() for name, value in other.items()}
    more = trainer.Trainer(task, 4 * ROLLOUT, folder, resume=True, run_options=EACH).train()
    assert [each.steps // ROLLOUT for each in more.evaluations] == [0, 1, 2, 3, 4]
    assert more.evaluations[:3] == first.evaluations
    assert more.model.num_timesteps == 4 * ROLLOUT
    if task.algo == "ppo":  # its settings let the step size fall to zero
        rate = more.model.policy.optimizer.param_groups[0]["lr"]
        assert rate == pytest.approx(0.0, abs=1e-12)
    moved = tensors(more.model)
    measured = [name for name in moved if name.endswith("features_extractor.scale")]  # once
    assert measured and all(torch.equal(moved[name], before[name]) for name in measured)
    actor = [name for name in moved if "policy " in name and name.endswith(".weight")]
    assert actor and all(not torch.equal(moved[name], before[name]) for name in actor)


def test_numpys_policy_drives_as_torchs(trained: Any) -> None:
    """Through an episode's end and with the memory of each, where there is one."""
    task, folder, _ = trained
    card = load_policy(folder / POLICY).card
    model: Any = get_algorithm(card.algorithm).load().load(folder / BEST, device="cpu")  # type: ignore[attr-defined]
    other = {"scenario": {"base": "step-steer", "duration": 0.5}}
    env = TrainingTask(VISION, env_options=task.env_options | other).vector_env(4)
    ours = PolicyController(env, folder / POLICY)
    obs, _ = env.reset(seed=0)
    mine, theirs, start = None, None, np.ones(4, np.bool_)
    acted = []
    for _ in range(120):
        a, mine = ours.predict(obs, mine, start)
        b, theirs = model.predict(obs, theirs, start, deterministic=True)
        assert np.abs(a - b).max() < 1e-6
        acted.append(a)
        obs, _, terminated, truncated, _ = env.step(a)
        start = terminated | truncated
    assert np.ptp(acted) > 1e-3


def test_the_same_seed_trains_the_same(trained: Any, tmp_path: Path) -> None:
    task, _, first = trained
    here = trainer.Trainer(task, 2 * ROLLOUT, tmp_path, run_options=EACH).train()
    assert [each.cost for each in here.evaluations] == [each.cost for each in first.evaluations]
    one, other = tensors(first.model), tensors(here.model)
    assert all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_weights_of_nan_stop_it(algo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the step; the checkpoint is that of the last evaluation."""
    built, real = list[Any](), trainer.Trainer.build

    def build(self: Any) -> Any:
        built.append(real(self))
        return built[0]

    def spoil(now: EvalCallback) -> None:
        if now.model.num_timesteps == 2 * ROLLOUT:
            with torch.no_grad():
                next(built[0].model.policy.parameters()).fill_(float("nan"))

    monkeypatch.setattr(trainer.Trainer, "build", build)
    means = RunOptions(eval_freq=ROLLOUT, report=spoil)
    with pytest.raises(FloatingPointError, match=f"after step {2 * ROLLOUT}; .*{CHECKPOINT}"):
        trainer.Trainer(tiny(algo), 3 * ROLLOUT, tmp_path, run_options=means).train()
    assert read_training(tmp_path).steps == ROLLOUT


@pytest.mark.parametrize("algo", ["tqc", "recurrent-ppo"])
def test_without_its_package_an_algorithm_names_the_extra(
    algo: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    with pytest.raises(ModuleNotFoundError, match=r"sb3_contrib: pip install 'sideslip\[train\]'"):
        TrainingTask(algo=algo)


def test_the_packages_settings_are_of_ids_there_are() -> None:
    import yaml

    for name, algorithm in ALGORITHMS.items():
        entries = yaml.safe_load((HYPERPARAMS / f"{algorithm.zoo}.yml").read_text())
        ours = {"default", INITIAL_ENTRY}
        assert "default" in entries and set(entries) - ours <= set(gym.registry)
        for key in entries:
            _check_settings(name, entries[key])
            assert _read_settings(name, key) == entries[key]
    assert len(list(HYPERPARAMS.iterdir())) == len(ALGORITHMS)


MEANT = "default: {policy: MlpPolicy, n_timesteps: 9, n_envs: 1"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (MEANT + ", n_stepz: 3}", "default: unknown option 'n_stepz' of ppo; known: .*n_steps"),
        (MEANT + ", seed: 3}", "unknown option 'seed' of ppo"),
        (MEANT + ', policy_kwargs: "dict(net_arch=[9])"}', "policy_kwargs is {name: value}"),
        (MEANT + ", learning_rate: lin_x}", "learning_rate is a positive number or lin_NUMBER"),
        (MEANT + ", learning_rate: -1.0}", "learning_rate is a positive number or lin_NUMBER"),
        (MEANT + ", n_steps: 2e3}", "n_steps is a number, got '2e3'; YAML reads 2e6 as text"),
        ("default: {n_envs: 1e2}", "n_envs is a number, got '1e2'"),
        ("default: {n_envs: 1}", "default: no n_timesteps, policy"),
        ("default: 3", "settings are {name: value}, got 3"),
        ("other: {n_envs: 1}", f"has no settings of {VISION}, and no 'default'"),
        ("[1]", "is no YAML of settings: {id: {name: value}} is expected"),
        ("{", "is no YAML of settings: while parsing"),
    ],
)
def test_a_fault_in_a_file_of_settings_is_named(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yml"
    path.write_text(text)
    with pytest.raises(ValueError, match=said) as caught:
        _read_settings("ppo", VISION, path)
    assert str(caught.value).startswith(str(path))


def test_a_batch_divides_a_rollout_where_there_is_one() -> None:
    """n_steps of sac and tqc is that of returns, and a batch is drawn from the buffer."""
    settings = TrainingTask().settings | {"n_steps": 3, "batch_size": 256}
    task = TrainingTask(num_envs=64, settings=settings)
    assert task.make_model_options(0.01)["batch_size"] == 192
    replayed = TrainingTask(algo="sac").settings | {"n_steps": 3, "batch_size": 256}
    task = TrainingTask(algo="sac", num_envs=64, settings=replayed)
    assert task.make_model_options(0.01)["batch_size"] == 256
    settings = TrainingTask().settings
    for num_envs in (1, 7, 100, 256, 1000):
        told = TrainingTask(num_envs=num_envs).make_model_options(0.02)
        assert num_envs * told["n_steps"] % told["batch_size"] == 0
        assert told["batch_size"] <= settings["batch_size"]
        assert told["gamma"] == pytest.approx(settings["gamma"] ** 2, rel=1e-12)  # longer period
