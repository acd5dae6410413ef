"""What a policy remembers: torch's cells, VecFrameStack's frames and running means."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents import PolicyController
from sideslip.agents.learned.layers import ACTIVATIONS, MEMORY_LAYERS, MovingAverages
from sideslip.agents.learned.network import Network
from sideslip.agents.learned.policy import Card, Policy, load_policy, save_policy

torch = pytest.importorskip("torch")
torch.set_num_threads(1)
sb3 = pytest.importorskip("stable_baselines3")
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations  # noqa: E402

from sideslip.agents.training.config import DistillConfig  # noqa: E402
from sideslip.agents.training.distill import (  # noqa: E402
    Demonstrations,
    _EpisodeBatches,
    _Student,
    _TraceLayer,
)
from sideslip.agents.training.export import TORCH_CELLS, convert_cells  # noqa: E402
from sideslip.agents.training.normalise import Standardisation  # noqa: E402

ID, ROWS, STEPS = "sideslip/YawVision-v0", 5, 200
CARD = Card.from_env_id(ID)
WIDE = len(CARD.observation)
RNG = np.random.default_rng(0)


def inputs(wide: int = WIDE) -> np.ndarray:
    """(steps, rows, wide), and where an episode begins: rows end at different steps."""
    return np.random.default_rng(1).normal(size=(STEPS, ROWS, wide)).astype(np.float32)


STARTS = np.random.default_rng(2).random((STEPS, ROWS)) < 0.02
STARTS[0] = True


def dense(wide: int, history: int = 1, cells: Any = (), **options: Any) -> Network:
    """A layer with an activation and one without, behind what remembers."""
    rng = np.random.default_rng(3)
    into = cells[-1].size if cells else wide * history
    weights = [rng.normal(size=(6, into)) / into**0.5, 0.3 * rng.normal(size=(1, 6))]
    biases = [0.1 * rng.normal(size=6), 0.1 * rng.normal(size=1)]
    numbers = {"mean": 0.1 * rng.normal(size=wide), "scale": rng.uniform(0.5, 2.0, wide)}
    return Network(
        weights=weights, biases=biases, history=history, cells=cells, **numbers | options
    )


MODULES = {cell.kind: module for module, cell in TORCH_CELLS.items()}


def torchs(kind: str, layers: int, wide: int = WIDE, size: int = 7) -> Any:
    torch.manual_seed(4)
    return MODULES[kind](wide, size, layers)  # type: ignore[arg-type]


def cells_of(module: Any) -> list[Any]:
    return list(convert_cells(module))


def driven(network: Network, x: np.ndarray, starts: np.ndarray = STARTS) -> np.ndarray:
    """Actions of `PolicyController.predict`, (steps, rows)."""
    agent = PolicyController(gym.make(ID), Policy("mine", network, CARD))
    state, actions = None, []
    for obs, start in zip(x, starts, strict=True):
        action, state = agent.predict(obs, state, start)
        actions.append(action[:, 0])
    return np.array(actions)


@pytest.mark.parametrize("kind", MODULES)
@pytest.mark.parametrize("layers", [1, 2])
def test_cells_are_torchs_over_whole_episodes(kind: str, layers: int) -> None:
    """In double precision to its rounding, in torch's single precision to 1e-6."""
    module, x = torchs(kind, layers), inputs()
    network = dense(WIDE, cells=cells_of(module), clip=5.0)
    z = np.clip((x - network.mean) * network.scale, -5.0, 5.0)
    for precision, bound in ((torch.float64, 1e-13), (torch.float32, 1e-6)):
        module = module.to(precision)
        size = 7 * layers
        state: Any = torch.zeros(2, layers, ROWS, 7, dtype=precision)
        ours, worst = np.zeros((ROWS, network.memory)), 0.0
        assert network.memory == size * (2 if kind == "lstm" else 1)
        for step, start in enumerate(STARTS):
            state[:, :, start], ours[start] = 0.0, 0.0
            with torch.no_grad():
                taken = torch.from_numpy(z[step]).to(precision)[None]
                before = (state[0], state[1]) if kind == "lstm" else state[0]
                output, after = module(taken, before)
            state = torch.stack(after) if kind == "lstm" else torch.stack([after, after])
            hidden = output[0].numpy().astype(np.float64)
            action = network(x[step].astype(np.float64), ours)
            theirs = np.tanh(hidden @ network.weights[0].T + network.biases[0])
            theirs = theirs @ network.weights[1].T + network.biases[1]
            worst = max(worst, float(np.abs(action - theirs).max()))
        assert worst < bound


@pytest.mark.parametrize("kind", MODULES)
def test_the_order_of_the_gates_counts(kind: str) -> None:
    """So that the test above would see a wrong one."""
    (cell,) = cells_of(torchs(kind, 1))
    right = driven(dense(WIDE, cells=[cell]), inputs())
    order = [1, 0, *range(2, cell.gates)]
    swapped = {
        name: np.concatenate([np.split(getattr(cell, name), cell.gates)[i] for i in order])
        for name in cell.arrays
    }
    wrong = driven(dense(WIDE, cells=[replace(cell, **swapped)]), inputs())
    assert np.abs(wrong - right).max() > 1e-3


@pytest.mark.parametrize("framewise", [True, False], ids=["frames scaled", "stack scaled"])
@pytest.mark.parametrize("history", [2, 4])
def test_history_is_the_stack_of_vec_frame_stack(history: int, framewise: bool) -> None:
    """Normalised before it is stacked, or after: zeros before the episode differ."""
    numbers = dense(WIDE if framewise else WIDE * history)
    scaling = {"mean": numbers.mean, "scale": numbers.scale}
    network = dense(WIDE, history, **scaling)
    plain = dense(WIDE * history, mean=np.zeros(WIDE * history), scale=np.ones(WIDE * history))
    low, high = -np.ones(WIDE, np.float32), np.ones(WIDE, np.float32)
    stack = StackedObservations(ROWS, history, gym.spaces.Box(low, high))
    x, theirs = inputs(), []
    scaled = (x - numbers.mean) * numbers.scale if framewise else x.astype(np.float64)
    stack.stacked_obs = stack.stacked_obs.astype(np.float64)
    for step, start in enumerate(STARTS):
        infos: list[Any] = [{"terminal_observation": scaled[step, i]} for i in range(ROWS)]
        z = stack.update(scaled[step], start, infos)[0] if step else stack.reset(scaled[0])
        z = z if framewise else (z - numbers.mean) * numbers.scale
        theirs.append(np.clip(plain(z)[:, 0], -1.0, 1.0))
    ours = driven(network, x)
    assert network.memory == (history - 1) * WIDE
    assert np.abs(ours - np.array(theirs)).max() < 1e-6
    assert np.abs(ours - driven(network, x, np.zeros_like(STARTS))).max() > 1e-3


def remembering() -> Network:
    return dense(WIDE, 3, cells_of(torchs("lstm", 2, 3 * WIDE)), activation="silu")


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


def test_a_row_of_a_batch_is_its_single_drive() -> None:
    network, x = remembering(), inputs()
    together = driven(network, x)
    agent = PolicyController(gym.make(ID), Policy("mine", network, CARD))
    for row in range(ROWS):
        state = None
        for step in range(60):
            action, state = agent.predict(x[step, row], state, STARTS[step, row : row + 1])
            assert action.shape == (1,) and action[0] == pytest.approx(
                together[step, row], abs=1e-6
            )


def test_predict_is_pure_and_a_row_with_a_nan_keeps_its_memory() -> None:
    agent = PolicyController(gym.make(ID), Policy("mine", remembering(), CARD))
    x = inputs()
    _, state = agent.predict(x[0])
    before = state.copy()
    first, _ = agent.predict(x[1], state)
    assert np.array_equal(state, before) and np.array_equal(agent.predict(x[1], state)[0], first)
    x[1, 2, 0] = np.nan
    action, after = agent.predict(x[1], state)
    assert np.isnan(action[2]).all() and np.array_equal(after[2], before[2])
    assert np.array_equal(np.delete(action, 2, 0), np.delete(first, 2, 0))


@pytest.mark.parametrize("framewise", [True, False])
@pytest.mark.parametrize("made", [remembering(), network(traces())], ids=["cells", "traces"])
def test_what_is_not_read_is_left_out_of_every_frame(made: Network, framewise: bool) -> None:
    scale = np.ones(WIDE)
    scale[[1, 5]] = 0.0
    scale = scale if framewise else np.tile(scale, made.history)
    whole = replace(made, mean=np.zeros(len(scale)), scale=scale)
    assert list(np.flatnonzero(~whole.reads)) == [1, 5]
    x = inputs().astype(np.float64)
    state, less = np.zeros((ROWS, whole.memory)), whole.select_inputs(whole.reads)
    other = np.zeros((ROWS, less.memory))
    for obs in x[:20]:
        assert less(obs[:, whole.reads], other) == pytest.approx(whole(obs, state), abs=1e-12)


@pytest.mark.parametrize("made", [remembering(), network(traces())], ids=["cells", "traces"])
def test_a_file_holds_the_memory(made: Network, tmp_path: Path) -> None:
    path = tmp_path / "mine.safetensors"
    save_policy(path, made, CARD)
    policy = load_policy(path)
    assert policy.network.description == made.description
    assert np.array_equal(driven(policy.network, inputs()), driven(made, inputs()))
    cells = [replace(cell, weight_in=cell.weight_in + 1.0) for cell in made.cells]
    assert replace(policy, network=replace(made, cells=cells)).salt != policy.salt


def test_every_kind_is_compared() -> None:
    """With torch's module, or with its formula."""
    assert set(MEMORY_LAYERS) == {*MODULES, MovingAverages.kind}


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_activations_are_torchs(activation: str) -> None:
    names = {
        "relu": "ReLU",
        "elu": "ELU",
        "leaky-relu": "LeakyReLU",
        "silu": "SiLU",
        "tanh": "Tanh",
    }
    x = np.concatenate([RNG.normal(size=100) * 3.0, [0.0, -800.0, 800.0]])
    theirs = getattr(torch.nn, names.get(activation, "Tanh"))()(torch.from_numpy(x)).numpy()
    one, none = np.ones((1, 1)), np.zeros(1)
    alone = Network(none, np.ones(1), [one, one], [none, none], activation)
    assert alone(x[:, None])[:, 0] == pytest.approx(theirs, abs=1e-13)


def test_a_mean_is_that_of_the_episode_and_then_fades() -> None:
    """Of a unit that is plain and of one that is bent, with weights written out again."""
    cell, x = traces(), RNG.normal(size=(60, 3, WIDE))
    plain = np.zeros(WIDE), np.ones(WIDE), [np.eye(cell.size)], [np.zeros(cell.size)]
    net = Network(*plain, cells=[cell])
    state = np.zeros((3, net.memory))
    u = x @ cell.weight_in.T + cell.bias_in
    u[..., 3:] = u[..., 3:] / (1.0 + np.exp(-u[..., 3:]))
    for step in range(60):
        seen = net(x[step], state)
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
    assert np.ptp(net(x[0], state)[1].reshape(3, 5), axis=0) == pytest.approx(0.0)


@pytest.mark.parametrize("cut", [150, 60])
@pytest.mark.parametrize("memory", [{}, {"cells": 7}, {"traces": 7}], ids=str)
def test_the_network_is_torchs(memory: dict[str, Any], cut: int) -> None:
    """Over blocks of its matrices and, where an episode is cut, with the state handed on."""
    torch.manual_seed(0)
    student = _Student(5, 2, DistillConfig(hidden=(9, 4), **memory), 0)
    rng = np.random.default_rng(1)
    mixing = np.eye(5) + 0.3 * np.ones((5, 5))
    scaling = Standardisation(rng.normal(size=5), rng.uniform(0.5, 2.0, 5), 8.0, mixing)
    x = rng.normal(size=(3, 150, 5)).astype(np.float32)
    if student.traces:
        student.traces.fit_whitening([drives_of(x)], scaling)
    z, net = torch.from_numpy(scaling.transform(x)), student.network(scaling)
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
    scaling = Standardisation(x.mean((0, 1)), 1.0 / x.std((0, 1)), 8.0, np.eye(3))
    x[0, 100:] = 1e3  # where it is over
    student, z = _Student(3, 1, DistillConfig(traces=4), 0), torch.from_numpy(scaling.transform(x))
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
    scaling = Standardisation(np.zeros(5), np.ones(5), 8.0, np.eye(5))
    first, *_ = _EpisodeBatches([drives_of(x)], scaling, DistillConfig(batch=3, **course))
    assert first[0].shape == (3, steps, 5)


def test_a_file_of_no_units_cannot_ask_for_any_memory(tmp_path: Path) -> None:
    """Tensors of nothing would fit a card of any number of frames."""
    none = traces(weight_in=np.zeros((0, WIDE)), bias_in=np.zeros(0), n_silu=0)
    save_policy(tmp_path / "mine.safetensors", network(none), CARD)
    with pytest.raises(ValueError, match="holds 0 numbers of float32, not one or more"):
        load_policy(tmp_path / "mine.safetensors")


GRU, TRACES = cells_of(torchs("gru", 1))[0], traces()
REFUSALS: dict[str, tuple[Any, dict[str, Any]]] = {
    "history is at least 1 frame": (None, {"history": 0}),
    "66 inputs are not 5 frames": (None, {"history": 5}),
    "with 22 inputs, got": (None, {"mean": np.zeros(7), "scale": np.ones(7)}),
    "22 inputs are not 3 frames": (None, {"cells": [GRU]}),
    "cell 1 takes 66 inputs, not 7": (None, {"cells": cells_of(torchs("gru", 1, 66)) * 2}),
    "layer 0 takes 8 inputs": (None, {"cells": cells_of(torchs("gru", 1, 66, 8))}),
    "arrays of a gru cell do not fit together": (GRU, {"bias_in": np.zeros(3)}),
    r"got \(\(5,\), \(5,\)\)": (TRACES, {"weight_in": np.zeros(5)}),
    r"weights \(units, inputs\) and biases \(units,\), got": (TRACES, {"bias_in": np.zeros(4)}),
    "of 5 units 6 cannot be bent": (TRACES, {"n_silu": 6}),
    "of 5 units -1": (TRACES, {"n_silu": -1}),
    "one time or more": (TRACES, {"times": ()}),
    "each above 0 steps": (TRACES, {"times": (3.0, 0.0)}),
    "each above 0 steps and": (TRACES, {"times": (float("nan"),)}),
    "1e\\+09 at most": (TRACES, {"times": (3, 10**400)}),
    "cell_0_weight_state: 147 are not finite": (
        dense(WIDE, cells=[GRU]),
        {"cells": [replace(GRU, weight_state=np.full_like(GRU.weight_state, np.nan))]},
    ),
}


@pytest.mark.parametrize("message", REFUSALS)
def test_memory_that_does_not_fit_is_refused(message: str) -> None:
    made, change = REFUSALS[message]
    with pytest.raises(ValueError, match=message):
        replace(remembering() if made is None else made, **change)
