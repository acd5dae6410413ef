"""Training of a correction of a filter's sideslip angle, on simulated drives.

The drivers cover the closed loop's distribution: no control, LQR on the filter, LQR with noise on
its action, and LQR on the correction that these taught. The network learns mean and variance of
the filter's error by the beta-NLL of Seitzer et al. (arXiv 2203.09168), beta = 0.5. Then one
factor on its deviation is fitted on held-out seeds, so that 95 % of their errors lie within 1.96
deviations.
"""

import functools
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from ...envs.record import Array
from ...estimators.learned.correction import DEVIATION, MIN_LOG_DEVIATION, learned, locate_stack
from ...estimators.learned.correction_file import Correction, CorrectionCard
from ...estimators.learned.network import Network
from ...estimators.vector.estimate import EstimateObservation
from ..controllers.base import Controller, NoControl
from ..controllers.lqr import Lqr
from ..env_info import AnyEnv
from ..rollout import iterate_steps
from .student import Single, compute_scale, make_dense_layers

import torch  # isort: skip  # after ours, which say which extra is missing

_OUTPUTS = ("beta", "gamma", "F_d", "N_d")  # what LQR reads
READ = (*_OUTPUTS, "bias", "front_tyres", "rear_tyres", "inverse_friction")
"""States that a network reads where the filter has them."""
_FIRST_ROUND = (("lqr", "fusion"), ("none", "fusion"), ("shaken", "fusion"), ("lqr", "vision"),
                ("shaken", "gps"))  # fmt: skip
_SECOND_ROUND = (("lqr", "fusion"), ("lqr", "vision"), ("lqr", "gps"))
"""Who drives with which slow sensors, on the filter, then on the correction."""
TRAINING, HELD_OUT = 2**67, 2**68  # first seeds; those of `callbacks` and `distill` differ
_SEEDS = 2**40  # seeds of each training
_EVERY = 10  # env-steps from one sample to the next
_MAX_SIDESLIP = 0.5  # rad: a car beyond is lost, and gives no sample
_NOISE_STD = 0.6  # standard deviation of the added action, as a fraction of full scale
_NOISE_DECAY = 0.95  # factor of the coloured noise in a step
_HIDDEN = (64, 64)
_CLIP = 8.0  # limit of a normalised input (standard deviations)
_BATCH, _RATE = 1024, 2e-3  # samples of a batch; Adam's learning rate, which falls to a fiftieth
_NORMAL_95 = 1.959964  # deviations within which 95 % of a normal distribution lie

_DriveSpec = tuple[str, dict[str, Any]]
"""A scenario in an env: an id, and options of `gym.make`."""


class _Samples(NamedTuple):
    """_Samples of a filter's error."""

    inputs: Single  # inputs that the network normalises, shape (k, inputs)
    errors: Array  # numbers to add to the filter's sideslip angle (rad), shape (k,)


class _NoisyLqr(Lqr):
    """LQR whose action is disturbed by coloured noise."""

    def __init__(self, env: AnyEnv) -> None:
        super().__init__(env)
        self._rng, self._noise = np.random.default_rng(0), np.zeros(())

    def predict(self, *arguments: Any, **options: Any) -> Any:
        """Compute LQR's action with noise, clipped."""
        action, state = super().predict(*arguments, **options)
        white_noise = self._rng.standard_normal(action.shape) * (1.0 - _NOISE_DECAY**2) ** 0.5
        self._noise = _NOISE_DECAY * self._noise + _NOISE_STD * white_noise
        return np.clip(action + self._noise, -1.0, 1.0).astype(np.float32), state


_AGENTS: dict[str, type[Controller]] = {"none": NoControl, "lqr": Lqr, "shaken": _NoisyLqr}


def _collect_samples(
    correction: Correction,
    drives: Sequence[_DriveSpec],
    drivers: Sequence[tuple[str, str]],
    seed: int,
    episodes: int,
) -> _Samples:
    """Collect samples of every drive with every driver, a key of `_AGENTS` and slow sensors."""
    seeds, collected = itertools.count(seed, episodes), list[_Samples]()
    for (env_id, options), (driver, sensors) in itertools.product(drives, drivers):
        options = {"sensors": sensors, "on_bad_action": "fail", **options}
        env: Any = gym.make_vec(env_id, num_envs=episodes, **options)
        read = [name for name in _OUTPUTS if name in correction.card.states]
        factory = functools.partial(learned, file=correction)
        env = EstimateObservation(env, factory, outputs=read, std=False)
        collected += _iterate_samples(env, _AGENTS[driver](env), next(seeds))
        env.close()
    return _concatenate(collected)


def _iterate_samples(env: Any, agent: Controller, seed: int) -> Iterator[_Samples]:
    """Iterate over samples of the first episodes' steps, one of `_EVERY`."""
    batch, seeds = env.estimator, list(range(seed, seed + env.num_envs))
    net = batch.first.net
    stack = slice(locate_stack(net), locate_stack(net) + int(net.sizes[0]))
    for step in itertools.islice(iterate_steps(env, agent, seeds), 0, None, _EVERY):
        truth, memory = step.info["beta"], batch.memory
        chosen = step.running & (np.abs(truth) < _MAX_SIDESLIP) & (memory[:, DEVIATION] > 0.0)
        beta = batch.filters[chosen, 0].x[:, net.beta]
        yield _Samples(memory[chosen, stack].astype(np.float32), truth[chosen] - beta)


def _concatenate(parts: Sequence[_Samples]) -> _Samples:
    return _Samples(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def train_correction(
    card: CorrectionCard,
    drives: Sequence[_DriveSpec],
    episodes: int = 32,
    epochs: int = 20,
    report: Callable[[str], None] = lambda _: None,
) -> Correction:
    """Train a correction on drives with the card's seed; equal arguments give equal bits.

    Args:
        card: Card of the correction.
        drives: Scenarios, as ids and options of `gym.make`.
        episodes: Seeds of each drive and driver; an eighth as many are held out.
        epochs: Passes over all samples; the first network has half of them.
        report: Function that is called with the name of the next stage.

    Returns:
        Correction with its card's quality.

    Raises:
        ValueError: There are no drives, episodes or epochs.
    """
    if not drives or episodes < 1 or epochs < 1:
        raise ValueError(f"{len(drives)} drives, {episodes} episodes, {epochs} epochs: 1 at least")
    start_time, first, n_test = time.process_time(), card.seed * _SEEDS, max(episodes // 8, 1)
    report("drives on the filter")
    plain, none = (np.zeros(card.inputs), np.ones(card.inputs)), np.zeros((2, card.inputs))
    blank = Correction(card, Network(*plain, [none], [np.zeros(2)], "relu", clip=np.inf))
    first_samples = _collect_samples(blank, drives, _FIRST_ROUND, TRAINING + first, episodes)
    inputs = first_samples.inputs  # normalised in place
    mean, spread = inputs.mean(0, np.float64), inputs.std(0, dtype=np.float64)
    scale = compute_scale(spread)
    np.subtract(inputs, mean.astype(np.float32), out=inputs)
    np.clip(inputs * scale.astype(np.float32), -_CLIP, _CLIP, out=inputs)
    report("the first network")
    draft = Correction(card, _fit_network(first_samples, mean, scale, (epochs + 1) // 2, card.seed))
    report("drives on the first network")
    second_seed = TRAINING + first + _SEEDS // 2
    second_samples = _collect_samples(draft, drives, _SECOND_ROUND, second_seed, episodes)
    report("the second network")
    all_samples = _concatenate([first_samples, second_samples])
    network = _fit_network(all_samples, mean, scale, epochs, card.seed)
    report("calibration")
    last = Correction(card, network)
    held_out = _collect_samples(last, drives, _SECOND_ROUND, HELD_OUT + first, n_test)
    errors, deviations = _compute_errors(last, held_out)
    factor = float(np.quantile(np.abs(errors / deviations), 0.95)) / _NORMAL_95
    biases = [*network.biases[:-1], network.biases[-1] + [0.0, np.log(factor)]]
    last = Correction(card, replace(network, biases=biases))
    test = _collect_samples(last, drives, _SECOND_ROUND, HELD_OUT + first + _SEEDS // 2, n_test)
    cpu_seconds = round(time.process_time() - start_time, 1)
    quality = _compute_quality(last, test)
    card = replace(card, temperature=factor, cpu_seconds=cpu_seconds, evaluation=quality)
    return replace(last, card=card)


def _fit_network(data: _Samples, mean: Array, scale: Array, epochs: int, seed: int) -> Network:
    """Fit a network to samples whose inputs are normalised by mean and scale."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    model = make_dense_layers(data.inputs.shape[1], *_HIDDEN, 2, activation=torch.nn.ReLU)
    unit = float(data.errors.std()) or 1.0  # of learned errors: their standard deviation (rad)
    x, y = torch.from_numpy(data.inputs), torch.from_numpy((data.errors / unit).astype(np.float32))
    optimiser = torch.optim.Adam(model.parameters(), _RATE)
    steps = epochs * -(-len(x) // _BATCH)
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.02, steps)
    for _ in range(epochs):
        for chosen in torch.split(torch.randperm(len(x)), _BATCH):
            middle, log_sd = model(x[chosen]).T
            log_sd = log_sd.clamp(MIN_LOG_DEVIATION - np.log(unit), 0.0 - np.log(unit))
            nll = 0.5 * ((y[chosen] - middle) * torch.exp(-log_sd)) ** 2 + log_sd
            optimiser.zero_grad()
            (nll * torch.exp(log_sd.detach())).mean().backward()  # sd^(2 beta), beta = 0.5
            optimiser.step()
            schedule.step()
    numbers = [x.detach().numpy().astype(np.float64) for x in model.parameters()]
    weights, biases = numbers[::2], numbers[1::2]
    weights[-1][0] *= unit
    biases[-1] = biases[-1] * [unit, 1.0] + [0.0, np.log(unit)]
    return Network(mean, scale, weights, biases, "relu", clip=_CLIP)


def _compute_errors(correction: Correction, data: _Samples) -> tuple[Array, Array]:
    """Compute the corrected errors and their standard deviations (rad), shape (k,) each."""
    ones = np.ones(correction.card.inputs)
    plain = replace(correction.network, mean=0.0 * ones, scale=ones)
    added, logarithm = plain(data.inputs.astype(np.float64)).T
    return data.errors - added, np.exp(np.clip(logarithm, MIN_LOG_DEVIATION, 0.0))


def _compute_quality(correction: Correction, data: _Samples) -> dict[str, float]:
    """Compute RMSE of the filter and of the correction (rad), 95 % coverage and NEES."""
    errors, deviations = _compute_errors(correction, data)
    squares = (errors / deviations) ** 2
    return {
        "filter_rmse": float(np.mean(data.errors**2) ** 0.5),
        "rmse": float(np.mean(errors**2) ** 0.5),
        "coverage": float(np.mean(squares < _NORMAL_95**2)),
        "nees": float(np.mean(squares)),
    }
