"""Running means that a policy remembers: by hand, by torch, in a file, and what is refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from sideslip.agents.learned.policy import Card, load_policy, save_policy
from sideslip.estimators.learned.forward import MovingAverages
from sideslip.estimators.learned.network import Network

pytest.importorskip("torch")
import torch

from sideslip.agents.training.distill import _EpisodeBatches
from sideslip.agents.training.student import (
    Demonstrations,
    DistillConfig,
    Scaling,
    Student,
    _TraceLayer,
)

CARD = Card.from_env_id("sideslip/YawVision-v0")
WIDE, RNG = len(CARD.observation), np.random.default_rng(0)
TIMES = (1.5, 30.0)


def traces(wide: int = WIDE, **change: Any) -> MovingAverages:
    rng = np.random.default_rng(1)
    numbers: dict[str, Any] = {"weight_in": rng.normal(size=(5, wide))}
    numbers |= {"bias_in": rng.normal(size=5), "n_silu": 2, "times": TIMES}
    return MovingAverages(**numbers | change)


def network(cell: MovingAverages) -> Network:
    rng = np.random.default_rng(2)
    weights, biases = [rng.normal(size=(1, cell.size))], [rng.normal(size=1)]
    return Network(np.zeros(WIDE), np.ones(WIDE), weights, biases, cells=[cell])


def test_a_mean_is_that_of_the_episode_and_then_fades() -> None:
    """Of a unit that is plain and of one that is bent, with weights written out again."""
    cell = traces()
    net, x = network(cell), RNG.normal(size=(60, 3, WIDE))
    state = np.zeros((3, net.memory))
    u = x @ cell.weight_in.T + cell.bias_in
    u[..., 3:] = u[..., 3:] / (1.0 + np.exp(-u[..., 3:]))
    for step in range(60):
        seen = net.compute_features(x[step], state)
        assert seen.shape == (3, cell.size) and seen[:, :5] == pytest.approx(u[step], abs=1e-12)
        for j, time in enumerate(TIMES):
            means, share = np.zeros((3, 5)), 1.0 - np.exp(-1.0 / time)
            for age in range(step + 1):
                means += max(share, 1.0 / (age + 1.0)) * (u[age] - means)
            own = seen[:, 5 * (1 + j) : 5 * (2 + j)]
            assert own == pytest.approx(means, abs=1e-12)
            if step + 1 < 1.0 / share:
                assert own == pytest.approx(u[: step + 1].mean(0), abs=1e-12)
    state[1] = 0.0  # an episode begins: its first units are its means
    assert np.ptp(net.compute_features(x[0], state)[1].reshape(3, 5), axis=0) == pytest.approx(0.0)


def test_dense_layers_alone_act_on_what_is_remembered() -> None:
    net, x = network(traces()), RNG.normal(size=(4, WIDE))
    state, same = np.zeros((4, net.memory)), np.zeros((4, net.memory))
    assert net.dense(net.compute_features(x, state)) == pytest.approx(net(x, same), abs=1e-12)
    alone = net.dense
    assert np.array_equal(state, same) and alone.dense is alone
    other = replace(alone, biases=[net.biases[0] + 1.0])
    assert net.replace_dense(other)(x) == pytest.approx(net(x) + 1.0, abs=1e-6)
    assert net.replace_dense(other).cells == net.cells


def test_what_is_not_read_is_left_out() -> None:
    scale = np.ones(WIDE)
    scale[[1, 5]] = 0.0
    net = replace(network(traces()), scale=scale)
    x, less = RNG.normal(size=(4, WIDE)), net.select_inputs(net.reads)
    assert less.inputs == WIDE - 2
    assert less(x[:, net.reads]) == pytest.approx(net(x), abs=1e-12)


@pytest.mark.parametrize("cut", [150, 60])
def test_the_network_is_torchs(cut: int) -> None:
    """Over blocks of its matrices and, where an episode is cut, with the state handed on."""
    torch.manual_seed(0)
    student, rng = Student(5, 2, DistillConfig(traces=7, hidden=(9, 4))), np.random.default_rng(1)
    mixing = np.eye(5) + 0.3 * np.ones((5, 5))
    scaling = Scaling(rng.normal(size=5), rng.uniform(0.5, 2.0, 5), mixing)
    x = rng.normal(size=(3, 150, 5)).astype(np.float32)
    cast(_TraceLayer, student.traces).fit_whitening([drives_of(x)], scaling)
    z, net = torch.from_numpy(scaling.mix_inputs(x)), student.network(scaling)
    first, between = student(z[:, :cut])
    parts = [first] + ([student(z[:, cut:], between)[0]] if cut < 150 else [])
    theirs, state = torch.cat(parts, 1).detach().numpy(), np.zeros((3, net.memory))
    ours = np.stack([net(each.astype(float), state) for each in x.swapaxes(0, 1)], axis=1)
    assert np.abs(ours - theirs).max() < 1e-6 < np.abs(np.diff(ours, axis=1)).max()


def drives_of(x: np.ndarray) -> Demonstrations:
    """Of which one is over early: what it shows then is not counted."""
    weights = np.ones(x.shape[:2], np.float32)
    weights[0, 100:] = 0.0
    return Demonstrations(
        x, x[..., :2], x[..., :0], weights, np.eye(2, dtype=np.float32), np.ones(len(x))
    )


def test_what_is_plain_goes_on_without_correlation() -> None:
    """Where a first input moves slowly: its short means are nearly one number."""
    rng = np.random.default_rng(1)
    x = rng.normal(size=(40, 300, 3)).astype(np.float32)
    x[..., 0] = x[..., 0].cumsum(1) / 10.0
    scaling = Scaling(x.mean((0, 1)), 1.0 / x.std((0, 1)), np.eye(3))
    x[0, 100:] = 1e3  # where it is over
    student, z = Student(3, 1, DistillConfig(traces=4)), torch.from_numpy(scaling.mix_inputs(x))
    layer: Any = student.traces
    there = drives_of(x).weights > 0.0
    before = layer(z)[0].detach().numpy()[there][:, :18]
    layer.fit_whitening([drives_of(x)], scaling)
    mixed = layer(z)[0].detach().numpy()[there][:, :18]
    assert np.abs(np.corrcoef(before.T) - np.eye(18)).max() > 0.99
    assert np.cov(mixed.T) == pytest.approx(np.eye(18), abs=0.3)  # what hardly varies less
    assert mixed.mean(0) == pytest.approx(0.0, abs=0.05)


def test_the_slope_reaches_the_first_step() -> None:
    """Which the last mean holds as much of as of any other."""
    layer, z = _TraceLayer(2, 3, (3, 1000)), torch.randn(1, 120, 2, requires_grad=True)
    last = layer(z)[0][0, -1]  # two inputs with two means of each, then the same of three units
    (slope,) = torch.autograd.grad(last[4], z)
    assert slope[0, :, 0].numpy() == pytest.approx(1.0 / 120.0, rel=1e-4)
    assert torch.equal(last[:2], z[0, -1]) and layer.size == len(last) == 15


@pytest.mark.parametrize(("course", "steps"), [({"traces": 4}, 150), ({"cells": 4}, 50)])
def test_an_episode_is_learned_through_whole(course: dict[str, Any], steps: int) -> None:
    """By a GRU in windows."""
    x = RNG.normal(size=(3, 150, 5)).astype(np.float32)
    scaling = Scaling(np.zeros(5), np.ones(5), np.eye(5))
    first, *_ = _EpisodeBatches([drives_of(x)], scaling, DistillConfig(batch=3, **course))
    assert first[0].shape == (3, steps, 5)


def test_a_file_holds_the_traces(tmp_path: Path) -> None:
    net, path = network(traces()), tmp_path / "mine.safetensors"
    save_policy(path, net, CARD)
    policy, x = load_policy(path), RNG.normal(size=(4, WIDE))
    (cell,) = policy.network.cells
    assert isinstance(cell, MovingAverages) and (cell.n_silu, cell.times) == (2, TIMES)
    assert np.array_equal(policy.network(x), net(x))


def test_a_file_of_no_units_cannot_ask_for_any_memory(tmp_path: Path) -> None:
    """Tensors of nothing would fit a card of any number of frames."""
    none = traces(weight_in=np.zeros((0, WIDE)), bias_in=np.zeros(0), n_silu=0)
    save_policy(tmp_path / "mine.safetensors", network(none), CARD)
    with pytest.raises(ValueError, match=r"traces with units.*\['traces', 0, 0, "):
        load_policy(tmp_path / "mine.safetensors")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"weight_in": np.zeros(5)}, r"got \(\(5,\), \(5,\)\)"),
        ({"bias_in": np.zeros(4)}, r"weights \(units, inputs\) and biases \(units,\), got"),
        ({"n_silu": 6}, "of 5 units 6 cannot be bent"),
        ({"n_silu": -1}, "of 5 units -1"),
        ({"times": ()}, "one time or more"),
        ({"times": (3.0, 0.0)}, "each above 0 steps"),
        ({"times": (float("nan"),)}, "each above 0 steps"),
        ({"times": (3, 10**400)}, "1e\\+09 at most"),
    ],
)
def test_traces_out_of_range_are_refused(change: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        traces(**change)
