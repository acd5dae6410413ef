"""`sideslip distill`: contests of a class as lessons, and each way to type it wrong."""

from pathlib import Path
from typing import Any
from unittest.mock import Mock

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("torch")
from sideslip.agents.learned.network import Network
from sideslip.agents.learned.policy import Policy, save_policy
from sideslip.agents.training.config import TrainingTask
from sideslip.benchmarks.control.entries import ADAPTIVE, ControlCase, Entry
from sideslip.benchmarks.control.tasks import list_scored_tasks
from sideslip.benchmarks.studies import policies
from sideslip.benchmarks.studies.policies import (
    FILTERS,
    VARIED,
    Lessons,
    _list_tasks,
    prepare_start,
)
from sideslip.envs.vehicle.parameters import VEHICLES
from tests.policies import GRU


def test_a_class_is_lessons_with_one_observation_and_the_cards() -> None:
    """So one network serves them all."""
    for estimator in FILTERS:
        lessons = Lessons("coms-zero-slip", estimator, "oracle-state-lqr", 2).make_tasks()
        assert len(lessons) == len(_list_tasks("coms-zero-slip")) == 3
        card = Lessons("coms-zero-slip", estimator).make_card()
        for each in lessons:
            assert tuple((e.name, e.unit) for e in each.cars.layout) == card.observation
            assert each.teacher.width == 1


def test_what_a_student_sees_besides_stands_in_lessons_card_and_tasks(tmp_path: Path) -> None:
    seen: dict[str, Any] = {"with_map": True, "fast": "all"}
    lessons = Lessons("coms-zero-slip", "", "none", 2, observation_options=seen)
    card, lesson = lessons.make_card(), lessons.make_tasks()[0]
    assert tuple((e.name, e.unit) for e in lesson.cars.layout) == card.observation
    assert ("curvature", "1/m") in card.observation and ("gyro_9", "rad/s") in card.observation
    assert "curvature" not in [entry.name for entry in lesson.teachers.layout]
    k = len(card.observation)
    network = Network(np.zeros(k), np.ones(k), [np.full((1, k), 0.1)], [np.zeros(1)])
    save_policy(tmp_path / "sees.safetensors", network, card)
    contest = _list_tasks("coms-zero-slip")[1]
    own = ControlCase(contest, Entry(str(tmp_path / "sees.safetensors")))
    env, agent = own.entry.make(contest, 2)
    assert "curvature" in agent.needs and agent.predict(env.reset(seed=0)[0])[0].shape == (2, 1)
    assert own.env_options["scenario"] == contest.scenario
    assert not set(seen) & ControlCase(contest, Entry("distill-coms-yaw")).env_options.keys()


@pytest.mark.parametrize("teacher", ADAPTIVE)
def test_a_student_on_joint_reads_what_its_teacher_reads(teacher: str) -> None:
    """To the bit, or it would learn to guess what its teacher's filter says."""
    cars, twins, agent = Lessons("coms-zero-slip", "joint", teacher, 2).make_tasks()[0]
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
    cars, twins, agent = Lessons("coms-zero-slip", "", "distill-coms-yaw", 2).make_tasks()[0]
    there = [{entry.name for entry in env.layout} for env in (cars, twins)]
    assert set(agent.needs) <= there[1] and "beta_hat" in there[1] - there[0]


@pytest.mark.long
def test_varied_lessons_differ_in_what_training_is_to_cover() -> None:
    """Tyres, mass, camera and GPS are others; not the observation, nor the teacher's cars."""
    lessons = Lessons("coms-zero-slip", "", "none", 32, varied=1).make_tasks()
    assert len(lessons) == 2 * len(_list_tasks("coms-zero-slip"))
    masses, late = set(), set()
    for plain, varied in zip(lessons[::2], lessons[1::2], strict=True):
        assert plain.cars.layout == varied.cars.layout
        for env in (plain.cars, varied.cars, varied.teachers):
            env.reset(seed=list(range(32)))
        assert list(varied.cars.vehicle) == list(varied.teachers.unwrapped.vehicle)
        usual, drawn = (
            [car.front_stiffness / VEHICLES["coms"].front_stiffness for car in lesson.cars.vehicle]
            for lesson in (plain, varied)
        )
        assert min(drawn) < 0.6 <= min(usual) and max(usual) <= 1.4 < max(drawn)
        masses.add(round(varied.cars.vehicle[0].mass / plain.cars.vehicle[0].mass, 9))  # one load
        late.add(varied.cars.slow_sensors[0]["camera"].delays)
    assert len(masses) == len(late) == 3
    assert VARIED["mass"][0] < min(masses) < 1.0 < max(masses) < VARIED["mass"][1]


def test_gps_or_camera_of_a_varied_lesson_is_out_for_seconds() -> None:
    """One of them, and each in some lesson."""
    lessons = Lessons("coms-zero-slip", "", "none", 4, 4).make_tasks()
    assert [lesson.cars.num_envs for lesson in lessons[:5]] == [4, 1, 1, 1, 1]
    names = [entry.name for entry in lessons[0].cars.layout]
    columns = [names.index(f"{sensor}_age") for sensor in ("gps", "camera")]
    out = set()
    for lesson in lessons[:5]:
        cars = lesson.cars
        cars.reset(seed=list(range(cars.num_envs)))
        idle = np.zeros((cars.num_envs, 1), np.float32)
        steps = [cars.step(idle)[0][0, columns] for _ in range(900)]
        late = np.max(steps[60:], axis=0) > 1.0  # before it none has come
        out.add(tuple(late))
    assert out == {(False, False), (True, False), (False, True)}


def test_the_wind_of_a_varied_lesson_blows_from_both_sides() -> None:
    contest = _list_tasks("coms-zero-slip")[0]
    _, drawn = policies._draw_scenarios(contest, 1, np.random.default_rng(0))
    assert isinstance(drawn, dict)
    change = {key: value for key, value in drawn.items() if not key.endswith("_outage")}
    change |= {"mirror": False}  # which would turn every other wind round by itself
    calm = {key: value for key, value in change.items() if not key.startswith("wind_")}
    aside = []
    for each in (change, calm):
        options = contest.env_options | {"scenario": each, "lead_in": 0.0}
        cars: Any = gym.make_vec(contest.env_id, num_envs=8, **options).unwrapped
        cars.reset(seed=list(range(8)))
        column = [entry.name for entry in cars.layout].index("gps_Y")
        idle = np.zeros((8, 1), np.float32)
        aside.append([cars.step(idle)[0][:, column] for _ in range(500)][-1])
    off = aside[0] - aside[1]
    assert off.min() < -0.05 and off.max() > 0.05 and len(set(off)) > 4


def test_who_cannot_drive_a_contest_is_no_number_of_a_card(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policies, "load_policy", Mock())
    monkeypatch.setattr(policies, "make_salted_seeds", lambda *_: [0])
    monkeypatch.setattr(policies, "run_chunk", lambda _: Mock(error="no camera"))
    contest = _list_tasks("coms-model")[0]
    with pytest.raises(ValueError, match=f"policy cannot drive {contest.name}: no camera"):
        policies._evaluate_task(Path("mine"), contest, 1)


def test_every_contest_is_in_one_class() -> None:
    kinds = dict.fromkeys(each.kind for each in list_scored_tasks())
    assert sum(len(_list_tasks(kind)) for kind in kinds) == len(list_scored_tasks())
    for kind in kinds:
        assert len({(each.env_id, each.vehicle) for each in _list_tasks(kind)}) == 1


def test_a_policy_goes_on_in_the_contests_that_its_algorithm_can_drive() -> None:
    """All of its class, but on tensors those of one kind of plant."""
    policy, task = prepare_start(Path(GRU))
    assert isinstance(policy, Policy)
    names = [each.scenario for each in _list_tasks("car-yaw")]
    driven = task(algo="gradient").scenarios
    assert set(names) - set(driven) == {"limit-friction-split"}  # a driver steers
    alone = task(algo="gradient", env_options={"scenario": "car-step"})
    assert not alone.scenarios and alone.env_options["vehicle"] == "passenger-car"
    assert prepare_start(Path("distill-car-yaw"))[1]().scenarios == names
    assert prepare_start(None) == (None, TrainingTask)
    assert prepare_start(Path("here/best_model.zip")) == (Path("here/best_model.zip"), TrainingTask)


def test_where_it_is_said_contests_are_varied_too() -> None:
    """Each so often, by the training's seed, and not as a distillation's lessons are."""
    _, task = prepare_start(Path("distill-coms-yaw"), 2)
    contests = _list_tasks("coms-zero-slip")
    names = [each.scenario for each in contests]
    found = task().scenarios
    varied = [each for each in found if not isinstance(each, str)]
    assert [each for each in found if isinstance(each, str)] == names
    assert [each["base"] for each in varied] == [name for name in names for _ in range(2)]
    assert all(each["wind_force"] and each["front_stiffness"] for each in varied)
    assert {"gps_outage", "camera_outage"} < {key for each in varied for key in each}
    assert task(seed=0).scenarios == found != task(seed=1).scenarios
    rng = np.random.default_rng(0)
    drawn = [each for contest in contests for each in policies._draw_scenarios(contest, 2, rng)]
    taught = [each for each in drawn if not isinstance(each, str)]
    outages = [
        {each[key] for each in those for key in each if key.endswith("_outage")}
        for those in (varied, taught)
    ]
    assert outages[0] and not outages[0] & outages[1]
    for agent, fields, said in (
        (None, {}, "for a policy of a class of tasks, got None"),
        (Path("here/best_model.zip"), {}, "got here/best_model.zip"),
        (Path("distill-coms-yaw"), {"scenarios": ["coms-step"]}, "without other scenarios"),
        (Path("distill-coms-yaw"), {"env_options": {"scenario": "coms-step"}}, "without other"),
    ):
        with pytest.raises(ValueError, match=said):
            prepare_start(agent, 2)[1](**fields)
