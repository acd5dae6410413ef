"""Distillation: the student's cars are the teacher's, torch's network is ours, and it learns."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("torch")
import torch

from sideslip.agents.baselines import make_oracle
from sideslip.agents.learned.policy import Card, load_policy
from sideslip.agents.rollout import COST_FLOOR
from sideslip.agents.training import distill as training
from sideslip.agents.training.config import DistillConfig
from sideslip.agents.training.distill import (
    _UNREAD,
    Demonstrations,
    DistillTask,
    RoundResult,
    _collect_demonstrations,
    _compute_scaling,
    _fit_model,
    _Student,
    _TraceLayer,
    distill,
)
from sideslip.agents.training.normalise import Standardisation
from sideslip.envs.task import ObservationEntry

ID, CARS = "sideslip/YawFusion-v0", 16
SHORT = {"base": "coms-step", "duration": 1.2, "onset": 0.1}
OPTIONS: dict[str, Any] = {"scenario": SHORT, "reference": "zero-slip"}
COURSE = DistillConfig(rounds=2, epochs=12, cells=8, hidden=(8,), learning_rate=1e-2)


def lesson(**options: Any) -> DistillTask:
    cars = gym.make_vec(ID, num_envs=CARS, **OPTIONS)
    return DistillTask(cars, *make_oracle("oracle-state-lqr", ID, CARS, **OPTIONS | options))


@pytest.fixture(scope="module", params=[8, 0], ids=["GRU", "no memory"])
def learned(request: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    path = tmp_path_factory.mktemp("distilled") / "student.safetensors"
    course, rounds = replace(COURSE, cells=request.param), list[RoundResult]()
    policy = distill(Card.from_env_id(ID, OPTIONS), [lesson()], course, path, rounds.append)
    return policy, rounds, path


@pytest.mark.long
def test_a_student_comes_nearer_to_its_teacher_on_seeds_it_has_not_seen(learned: Any) -> None:
    policy, *_ = learned
    last, seeds = policy.network, range(900, 900 + CARS)
    nothing = {name: [0.0 * x for x in getattr(last, name)] for name in ("weights", "biases")}
    idle = replace(last, **nothing)
    ours, none = (
        _collect_demonstrations(lesson(), replace(policy, network=each), seeds, 0.0).costs.mean()
        for each in (last, idle)
    )
    teachers = _collect_demonstrations(lesson(), None, seeds, 0.0).costs.mean()
    assert teachers < ours < teachers + 0.5 * (none - teachers)


def test_a_student_with_traces_mixes_them_once_by_the_first_drives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Any, _TraceLayer]] = []

    def whiten(self: _TraceLayer, drives: Any, scaling: Standardisation) -> None:
        whole(self, drives, scaling)
        asked.append((drives, self))

    whole = _TraceLayer.fit_whitening
    monkeypatch.setattr(_TraceLayer, "fit_whitening", whiten)
    course = replace(COURSE, rounds=2, epochs=1, cells=0, traces=3, auxiliary_weight=0.5)
    path = tmp_path / "student.safetensors"
    policy = distill(Card.from_env_id(ID, OPTIONS), [lesson()], course, path)
    ((drives, traces),) = asked
    assert len(drives) == 1 and traces.mean.abs().max() > 0.0
    (cell,) = load_policy(path).network.cells
    assert cell.description[:3] == ["traces", len(policy.card.observation) + 3, 3]


def test_the_file_is_the_last_rounds_and_its_card_has_the_numbers(learned: Any) -> None:
    policy, rounds, path = learned
    there = load_policy(path)
    assert there.salt == policy.salt
    assert there.card.steps == rounds[-1].steps == COURSE.rounds * CARS * 120
    assert there.card.cpu_seconds > 0.0


def test_what_is_told_is_what_the_teacher_reads_and_the_student_does_not_see() -> None:
    """On seeds that it has not seen, the cells know the yaw rate, which so short a training shows
    them; the policy's file has nothing of it."""
    seen, other = (
        _collect_demonstrations(lesson(), None, range(at, at + CARS), 0.1) for at in (0, 900)
    )
    cars, _, teacher = lesson()
    names = [entry.name for entry in cars.layout]
    told = [name for name in teacher.needs if name not in names]
    assert {"beta_hat", "gamma_hat"} <= set(told) and len(told) == seen.privileged.shape[2]
    rates = seen.privileged[..., told.index("gamma_hat")], seen.obs[..., names.index("gyro")]
    assert np.corrcoef(rates[0].ravel(), rates[1].ravel())[0, 1] > 0.9
    mean, deviation = seen.privileged.mean((0, 1)), seen.privileged.std((0, 1))
    plain = Standardisation(mean, 1.0 / np.maximum(deviation, 1e-9), 8.0)
    seen, other = (x._replace(privileged=plain.transform(x.privileged)) for x in (seen, other))
    course = replace(COURSE, auxiliary_weight=1.0)
    torch.manual_seed(0)
    model = _Student(len(names), 1, course, len(told))
    scaling = _compute_scaling([seen], cars.layout, ("beta_hat",))
    _fit_model(model, [seen], scaling, course, 60)
    out = model(torch.from_numpy(scaling.transform(other.obs)))[0].detach().numpy()
    missed, varies = (
        x.mean((0, 1)) for x in ((out[..., 1:] - other.privileged) ** 2, other.privileged**2)
    )
    rate = told.index("gamma_hat")
    assert missed[rate] < 0.3 * varies[rate]
    assert model.network(scaling).width == 1
    assert _Student(5, 1, COURSE, 2).auxiliary_head is None


def test_windows_in_which_every_episode_is_over_tell_nothing() -> None:
    """Such as those of a car that spins early, in a batch of its own."""
    seen = _collect_demonstrations(lesson(), None, range(CARS), 0.1)
    weights = seen.weights.copy()
    weights[:, 1:] = 0.0
    course = replace(COURSE, cells=4, auxiliary_weight=1.0, batch=1)
    model = _Student(seen.obs.shape[2], 1, course, seen.privileged.shape[2])
    scaling = _compute_scaling([seen], lesson()[0].layout, ("beta_hat",))
    assert np.isfinite(_fit_model(model, [seen._replace(weights=weights)], scaling, course, 1))


def test_a_teacher_of_other_cars_is_refused() -> None:
    with pytest.raises(ValueError, match="cars are others than the student's"):
        _collect_demonstrations(lesson(scenario=SHORT | {"friction": 0.5}), None, range(CARS), 0.0)


class Watched:
    """A teacher that knows no action for one car, and notes of what it is told."""

    def __init__(self, teacher: Any, blind: int) -> None:
        self.teacher, self.blind, self.acts = teacher, blind, list[Any]()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.teacher, name)

    def predict(self, *seen: Any) -> Any:
        label, memory = self.teacher.predict(*seen)
        label[self.blind] = np.nan
        return label, memory

    def record_action(self, memory: Any, action: Any) -> None:
        self.acts.append(action.copy())
        self.teacher.record_action(memory, action)


def test_a_teacher_is_told_what_was_done_and_teaches_what_it_knows() -> None:
    """What it would have done, shaken by noise of which 0.95 are left after a step."""
    plain = lesson()
    watched, done, step = Watched(plain.teacher, 3), list[Any](), plain.cars.step

    def noted(action: Any) -> Any:
        done.append(action.copy())
        return step(action)

    plain.cars.step = noted
    seen = _collect_demonstrations(plain._replace(teacher=watched), None, range(CARS), 0.01)
    assert np.array_equal(watched.acts, done) and len(done) == seen.labels.shape[1]
    assert not seen.weights[3].any() and (np.delete(seen.weights, 3, axis=0) > 0.0).all()
    shaken = np.stack(done, axis=1)[..., 0] - seen.labels[..., 0]
    assert 0.9 < np.corrcoef(shaken[:, 1:].ravel(), shaken[:, :-1].ravel())[0, 1] < 0.99


def test_what_the_teachers_sensors_do_changes_no_car() -> None:
    """`oracle-parameters` has sensors without biases: another record of the same motion."""
    knowing = make_oracle("oracle-parameters-lqr", ID, CARS, **OPTIONS)
    seen = _collect_demonstrations(
        lesson()._replace(teachers=knowing[0], teacher=knowing[1]), None, range(CARS), 0.1
    )
    assert (seen.weights > 0.0).all() and np.ptp(seen.labels) > 0.0


def test_a_drive_that_is_lost_weighs_as_a_usual_one() -> None:
    """So that what led there is learned, however much it cost."""
    plain, capped = (
        _collect_demonstrations(lesson(), None, range(CARS), 0.1, most) for most in (np.inf, 0.0)
    )
    assert np.allclose(plain.weights[:, 0], 1.0 / (plain.costs + COST_FLOOR))
    assert np.allclose(capped.weights, 1.0 / COST_FLOOR) and (capped.costs == plain.costs).all()


def test_a_student_that_sees_what_its_teacher_reads_reads_nothing_else() -> None:
    cars = lesson().cars
    seen = [_collect_demonstrations(lesson(), None, range(CARS), 0.1)]
    names = [entry.name for entry in cars.layout]
    for needs, there in ((("steer", "beta_ref"), {"steer"}), (("beta_hat",), None)):
        scaling = _compute_scaling(seen, cars.layout, needs)
        reads = {name for name, each in zip(names, scaling.scale, strict=True) if each > 0.0}
        assert reads == there if there else "gyro" in reads and not reads & set(_UNREAD)


def test_an_age_is_scaled_as_it_varies_while_packets_come() -> None:
    """Ten seconds that stand for none yet, and an outage, would else hide a step of 10 ms."""
    ages = np.tile(np.arange(12) * 0.01 + 0.05, 25)[None, :, None].astype(np.float32)
    ages[:, :20], ages[:, 200:] = 10.0, np.arange(100)[:, None] * 0.01 + 0.17
    layout = [ObservationEntry(name, "-", -10.0, 10.0) for name in ("gps_age", "gyro")]
    obs = np.concatenate([ages, np.sin(ages)], axis=-1)
    drives = Demonstrations(
        obs, obs, obs, np.ones((1, 300), np.float32), np.eye(2, dtype=np.float32), np.ones(1)
    )
    usual = _compute_scaling([drives], layout, ("beta",))
    deviation = Standardisation(obs.mean((0, 1)), 1.0 / obs.std((0, 1)), 8.0)
    ends = np.percentile(ages, (16, 50))  # the usual age is 0, a soon one a deviation before it
    assert (ends - usual.mean[0]) * usual.scale[0] == pytest.approx([-1.0, 0.0])
    z, plain = (x._replace(mixing=None).transform(obs)[0, :, 0] for x in (usual, deviation))
    assert z[:20].min() == 8.0 == z[-1] and np.abs(z[20:200]).max() < 4.0
    assert np.diff(z[24:36]).min() > 0.1 > 20.0 * np.diff(plain[24:36]).max()


def test_a_training_that_diverges_stops_with_the_step_and_leaves_the_last_good_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, real = tmp_path / "student.safetensors", _fit_model
    drives = [_collect_demonstrations(lesson(), None, range(CARS), 0.0)]
    names, model = len(drives[0].obs[0, 0]), _Student(len(drives[0].obs[0, 0]), 1, COURSE, 0)
    with pytest.raises(FloatingPointError, match=r"the loss is nan at step \d+"):
        scaling = Standardisation(np.full(names, np.nan), np.ones(names), 8.0, np.eye(names))
        real(model, drives, scaling, COURSE, 1)
    calls: list[Any] = []

    def second(*arguments: Any) -> float:
        calls.append(arguments)
        if len(calls) == 2:
            raise FloatingPointError("the loss is nan at step 3")
        return real(*arguments)

    monkeypatch.setattr(training, "_fit_model", second)
    quick = replace(COURSE, epochs=1)
    with pytest.raises(FloatingPointError):
        distill(Card.from_env_id(ID, OPTIONS), [lesson()], quick, path)
    assert load_policy(path).card.steps == CARS * 120


def test_mixed_inputs_show_what_two_of_them_differ_by() -> None:
    """As course less heading, whose difference is a tenth of either: it varies like the rest."""
    cars = lesson().cars
    seen = _collect_demonstrations(lesson(), None, range(CARS), 0.1)
    names, rng = [entry.name for entry in cars.layout], np.random.default_rng(0)
    a, b = (names.index(name) for name in ("gps_course", "camera_psi"))
    seen.obs[..., a] = rng.normal(size=seen.obs.shape[:2])
    apart = 0.1 * rng.normal(size=seen.obs.shape[:2])
    seen.obs[..., b] = seen.obs[..., a] + apart
    z = _compute_scaling([seen], cars.layout, ("beta_hat",)).transform(seen.obs)
    shown = z[..., b] - z[..., a]
    assert 1.2 < shown.std() < 1.6  # of two that vary by 1, the square root of 2
    assert np.corrcoef(shown.ravel(), apart.ravel())[0, 1] > 0.99
