"""What a network sees: standardised observations, clipped."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
import torch

from sideslip.agents.training.config import TrainingTask
from sideslip.agents.training.normalise import CLIP, Standardised, measure_scaling


def test_observations_are_standardised_by_the_network() -> None:
    env = TrainingTask(env_options={"scenario": "sine-with-dwell"}, seed=3).vector_env(16)
    mean, scale, clip, mixing = measure_scaling(env, 0.4, 5)
    assert mixing is None  # nobody asked for it
    names = [entry.name for entry in env.unwrapped.layout]  # type: ignore[attr-defined]
    assert scale[names.index("gamma_ref")] == 0.0  # zero-slip: it never varies
    layer = Standardised(env.single_observation_space, mean, scale, clip)
    obs = 30.0 * np.random.default_rng(0).standard_normal((50, len(mean)))
    wanted = np.clip((obs - np.array(mean)) * np.array(scale), -CLIP, CLIP)
    given = layer(torch.tensor(obs, dtype=torch.float32)).numpy()
    assert given == pytest.approx(wanted, abs=1e-3)
    assert np.abs(wanted).max() == CLIP and not list(layer.parameters())
    free = Standardised(env.single_observation_space, mean, scale, None)
    assert float(free(torch.tensor(obs, dtype=torch.float32)).abs().max()) > CLIP
    assert free.numbers[2] is None and layer.numbers[2] == clip


def test_what_is_read_has_no_correlation() -> None:
    """On other cars than it was measured on, too: nearly all mixtures vary by about one."""
    env = TrainingTask().vector_env(64)
    mean, scale, clip, mixing = measure_scaling(env, 0.4, 5, mixed=True)
    rng, noise, seen = np.random.default_rng(6), np.zeros((64, 1)), []
    env.reset(seed=6)
    for step in range(400):
        noise = 0.95 * noise + 0.31 * rng.standard_normal((64, 1))
        obs, *_ = env.step((0.4 * noise).clip(-1.0, 1.0).astype(np.float32))
        seen += [obs] if step >= 20 else []
    drives = torch.as_tensor(np.concatenate(seen))

    def about_one(mixed: list[list[float]] | None) -> int:
        layer = Standardised(env.single_observation_space, mean, scale, clip, mixed)
        sizes = np.linalg.eigvalsh(np.cov(layer(drives).numpy(), rowvar=False))
        return int(((sizes > 0.5) & (sizes < 2.0)).sum())

    read = np.count_nonzero(scale)
    assert about_one(mixing) >= read - 3 and about_one(None) < read / 2


def test_a_network_reads_what_it_is_told_to_and_nothing_else() -> None:
    env = TrainingTask().vector_env(8)
    plain = measure_scaling(env, 0.4, 5)
    names = [entry.name for entry in env.unwrapped.layout]  # type: ignore[attr-defined]
    some = measure_scaling(env, 0.4, 5, ["gyro", "steer"])
    read = np.isin(names, ["gyro", "steer"])
    assert np.array_equal(some[1], np.where(read, plain[1], 0.0)) and some[0] == plain[0]
    assert np.count_nonzero(some[1]) == 2 < np.count_nonzero(plain[1])


def test_scales_are_of_seconds_however_short_a_control_period_is() -> None:
    """In 0.4 s nobody steers: what was measured over steps was never read."""
    options = {"scenario": "sine-with-dwell", "control_period": 1}
    env = TrainingTask(env_options=options).vector_env(4)
    names = [entry.name for entry in env.unwrapped.layout]  # type: ignore[attr-defined]
    assert measure_scaling(env, 0.4, 5)[1][names.index("steer_command")] > 0.0
