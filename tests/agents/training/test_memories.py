"""Memories: they see no future, forget with an episode, and go on where they were cut."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("torch")
import torch

from sideslip.agents.optimum import Lqg, wrap_optimal_estimate
from sideslip.agents.training.distill import DistillTask, _collect_demonstrations
from sideslip.agents.training.recurrent import (
    MAX_AGE,
    MEMORIES,
    RATE,
    CompactObservation,
    _Kalman,
    _MemoryAgent,
    train_memory,
)
from sideslip.agents.training.student import DistillConfig, Scaling

ID, CARS, INPUTS, FRESH, STEPS = "sideslip/LinearYawVision-v0", 16, 5, 4, 90
CAMERA = {"period": 0.04, "delays": [0.03], "loss": 0.3}
SHORT = gym.spec(ID).kwargs["scenario"] | {"duration": 1.0}
COURSE = DistillConfig(rounds=2, epochs=10, learning_rate=5e-3, noise=0.3)


@pytest.fixture(params=MEMORIES)
def name(request: Any) -> str:
    return str(request.param)


def made(name: str, late: int = 3) -> tuple[Any, Any]:
    """A memory whose parts all act, and inputs (2, STEPS, INPUTS) with packets."""
    torch.manual_seed(0)
    model, rng = MEMORIES[name](INPUTS, FRESH, late), np.random.default_rng(0)
    with torch.no_grad():
        for each in model.parameters():
            each.add_(0.02 * torch.randn_like(each))
    z = rng.standard_normal((2, STEPS, INPUTS)).astype(np.float32)
    return model, torch.from_numpy(z)


def test_a_future_input_changes_no_action_and_a_past_one_does(name: str) -> None:
    model, z = made(name)
    changed = z.clone()
    changed[:, 50] = -changed[:, 50]
    with torch.no_grad():
        before, after = model(z)[0], model(changed)[0]
    assert before.shape == (2, STEPS, 1)
    assert torch.equal(before[:, :50], after[:, :50]) or (
        (before[:, :50] - after[:, :50]).abs().max() < 1e-6
    )
    assert (before[:, 50] - after[:, 50]).abs().min() > 1e-5
    later = (before[:, 51:] - after[:, 51:]).abs().amax((0, 2))
    assert bool((later[:10] > 1e-6).any()) == (name != "mlp")
    if name == "frames":
        assert later[30] > 1e-6 > later[31:].max()


def test_windows_and_single_steps_are_the_whole(name: str) -> None:
    model, z = made(name)
    with torch.no_grad():
        whole = model(z)[0]
        for size in (1, 30):
            state, parts = None, []
            for window in torch.split(z, size, 1):
                actions, state = model(window, state)
                parts.append(actions)
            assert (torch.cat(parts, 1) - whole).abs().max() < 1e-5


def test_an_episode_begins_without_the_last_ones_memory(name: str) -> None:
    model, z = made(name)
    agent, x = _MemoryAgent(model, Scaling(np.zeros(INPUTS), np.ones(INPUTS))), z.numpy()
    state = None
    for t in range(20):
        _, state = agent.predict(x[:, t], state, np.zeros(2, bool))
    kept, _ = agent.predict(x[:, 20], state, np.zeros(2, bool))
    again, _ = agent.predict(x[:, 20], state, np.array([True, False]))
    fresh, _ = agent.predict(x[:, 20])
    assert np.abs(again[0] - fresh[0]).max() < 1e-6 and np.abs(again[1] - kept[1]).max() < 1e-6
    assert name == "mlp" or np.abs(kept[0] - again[0]).max() > 1e-6
    assert np.abs(kept).max() <= 1.0


def test_without_packets_an_observer_that_is_late_knows_what_a_prompt_one_knows() -> None:
    """It leads what it knew through the inputs since then, by the same equations."""
    z, none = made("kalman")[1], torch.zeros(2, STEPS, 1)
    known = []
    for late in (0, 7):
        torch.manual_seed(1)
        with torch.no_grad():
            known.append(_Kalman(INPUTS, FRESH, late)._update_memory(z, none, None)[0])
    assert (known[0] - known[1]).abs().max() < 1e-5 < known[0].abs().max()


def lesson(**camera: Any) -> DistillTask:
    options: dict[str, Any] = {"camera": CAMERA | camera, "scenario": SHORT}
    twins = wrap_optimal_estimate(gym.make_vec(ID, CARS, **options))
    return DistillTask(CompactObservation(gym.make_vec(ID, CARS, **options)), twins, Lqg(twins))


def test_inputs_are_whitened() -> None:
    mine = lesson()
    seen = [_collect_demonstrations(mine, None, range(CARS), 0.3)]
    inputs = len(mine.cars.layout)
    model = MEMORIES["mlp"](inputs, inputs - 1, 0)
    scaling = model.fit_scaling(seen, mine.cars.layout, mine.teacher.needs)
    z = scaling.mix_inputs(seen[0].obs).reshape(-1, inputs) @ model.mix.numpy()
    spread = np.linalg.eigvalsh(np.cov(z.T))
    assert spread.max() == pytest.approx(1.0, abs=1e-3)
    assert np.sum(spread > 0.99) == inputs - 2  # both torques, and both angles, are one


def test_the_offset_becomes_the_rate_between_two_pictures_and_is_forgotten_at_a_reset() -> None:
    options: dict[str, Any] = {"camera": CAMERA | {"loss": 0.0}, "scenario": SHORT}
    cars, plain = CompactObservation(gym.make_vec(ID, 2, **options)), gym.make_vec(ID, 2, **options)
    base: Any = plain
    ours = [entry.name for entry in cars.layout]
    theirs = [entry.name for entry in base.layout]
    assert not any(each.startswith(("accel", "wheel", "roll")) for each in ours)
    assert cars.observation_space.shape == (2, len(ours))
    with pytest.raises(ValueError, match="reset all rows at once"):
        cars.reset(options={"reset_mask": np.arange(2) == 1})
    x, y = cars.reset(seed=0)[0], plain.reset(seed=0)[0]
    rates, pictures = [], []
    for step in range(120):  # into the next episode
        assert np.array_equal(x[:, ours.index("gyro_9")], y[:, theirs.index("gyro_9")])
        assert x[:, ours.index("camera_age")].max() <= MAX_AGE
        if y[0, theirs.index("camera_fresh")]:
            pictures.append((step, float(y[0, theirs.index("camera_y_l")])))
            rates.append(float(x[0, ours.index(RATE)]))
        still = np.zeros((2, 1), np.float32)
        x, y = cars.step(still)[0], plain.step(still)[0]
    steps, offsets = np.array(pictures).T
    found, within = np.diff(offsets) / (0.01 * np.diff(steps)), np.diff(steps) == 4
    assert np.allclose(np.array(rates[1:])[within], found[within], rtol=1e-3, atol=1e-3)
    assert rates[0] == 0.0 and np.sum(~within) == 1 and rates[1 + np.argmin(within)] == 0.0


def test_a_memory_comes_nearer_to_the_filter() -> None:
    rounds: list[Any] = []
    agent = train_memory("frames", lesson(), COURSE, 3, 3e-4, rounds.append)
    assert [each.steps for each in rounds] == [CARS * 100, 2 * CARS * 100]
    ours, idle = (
        np.square(_collect_demonstrations(lesson(), each, range(CARS), 0.0).labels).sum()
        for each in (agent, _MemoryAgent(_still(agent.model), agent.scaling))
    )
    assert ours < 0.7 * idle  # what remains to be done about the car


def _still(model: Any) -> Any:
    other = MEMORIES["mlp"](model.inputs, model.fresh_index, model.delay_steps)
    for each in other.parameters():
        each.data.zero_()
    return other


def test_the_same_seed_learns_the_same() -> None:
    course = DistillConfig(rounds=1, epochs=1, noise=0.3)
    first, second = (train_memory("gru", lesson(), course, 3).model.state_dict() for _ in range(2))
    assert all(torch.equal(first[key], second[key]) for key in first)
