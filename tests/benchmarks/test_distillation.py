"""`sideslip distill`: contests of a class as lessons, and each way to type it wrong."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
from sideslip.benchmarks.control.cells import ADAPTIVE
from sideslip.benchmarks.control.contests import contests
from sideslip.benchmarks.distillation import FILTERS, card_of, contests_of, lessons_of
from tests.benchmarks.conftest import Run


def test_a_class_is_lessons_with_one_observation_and_the_cards() -> None:
    """So one network serves them all."""
    for estimator in FILTERS:
        lessons = lessons_of("coms-zero-slip", "oracle-state-lqr", estimator, 2)
        assert len(lessons) == len(contests_of("coms-zero-slip")) == 7
        card = card_of("coms-zero-slip", estimator)
        for each in lessons:
            assert tuple((e.name, e.unit) for e in each.cars.layout) == card.observation
            assert each.teacher.width == 1


@pytest.mark.parametrize("teacher", ADAPTIVE.values())
def test_a_student_on_joint_reads_what_its_teacher_reads(teacher: str) -> None:
    """To the bit, or it would learn to guess what its teacher's filter says."""
    cars, twins, agent = lessons_of("coms-zero-slip", teacher, "joint", 2)[0]
    seen = [env.reset(seed=[3, 4])[0] for env in (cars, twins)]
    for _ in range(60):
        seen = [env.step(np.full((2, 1), 0.2, np.float32))[0] for env in (cars, twins)]
    read = [
        obs[:, [[entry.name for entry in env.layout].index(name) for name in agent.needs]]
        for obs, env in zip(seen, (cars, twins), strict=True)
    ]
    assert np.array_equal(*read) and np.ptp(read[0]) > 0.0


def test_a_policy_teaches_on_the_filter_of_its_card() -> None:
    """So that one without a filter learns from one that has it, which costs little to ask."""
    cars, twins, agent = lessons_of("coms-zero-slip", "distill-coms-yaw", "", 2)[0]
    there = [{entry.name for entry in env.layout} for env in (cars, twins)]
    assert set(agent.needs) <= there[1] and "beta_hat" in there[1] - there[0]


def test_every_contest_is_in_one_class() -> None:
    kinds = dict.fromkeys(each.kind for each in contests())
    assert sum(len(contests_of(kind)) for kind in kinds) == len(contests())
    for kind in kinds:
        assert len({(each.env_id, each.vehicle) for each in contests_of(kind)}) == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--class", "coms"), "unknown class of contests 'coms'; known: coms-model"),
        (("--class", "coms-model", "--estimator", "dakf"), "unknown estimator 'dakf'"),
        (("--class", "coms-model", "--teacher", "oracle"), "unknown agent 'oracle'"),
        (("--class", "coms-model", "--teacher", "lane-keeping"), "needs psi_hat, y_l_hat"),
        (("--class", "coms-model", "--rounds", 0), "1 at least"),
    ],
)
def test_a_distillation_that_cannot_be_is_one_line(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    status, _, err = run("distill", "mine", *arguments)
    assert status == 2 and said in err and not list(tmp_path.iterdir())
