"""Files of an older tree are read as ever, and the names that stand in files are what they were.

`files/old` holds a file of each kind that the package writes and does not ship, of version 0.2.0:
a training's checkpoint and the zips of PPO and of analytic gradients, which name modules and
classes; specs of environments; a scenario, a vehicle and a camera; a drive; rows; a session.
`names.json` lists the names in these, on wires and in `info`: a new name for one of them comes
beside the old one. Cards, tuned options and calibrations are read where they lie.
"""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

import sideslip.agents.learned.policy
import sideslip.benchmarks.control.calibration
import sideslip.benchmarks.entrants.challenge
from sideslip.agents import make_agent
from sideslip.agents.baselines import read_tuned
from sideslip.agents.learned.policy import list_shipped, load_policy
from sideslip.agents.live import controller, messages
from sideslip.agents.rollout import rollout
from sideslip.benchmarks.control.tasks import TaskMeasurement, _read_tasks
from sideslip.benchmarks.entrants.challenge import _read_baselines
from sideslip.benchmarks.harness.results import ResultRow, read_json
from sideslip.envs.recordings.tables import COLUMNS
from sideslip.envs.scenarios.manoeuvres import make_scenario
from sideslip.envs.scenarios.scenario import Scenario
from sideslip.envs.sensors.camera.images import Pinhole
from sideslip.envs.vehicle.parameters import PASSENGER_CAR, WIRE_TABLES, Vehicle, make_vehicle
from sideslip.estimators import EstimateObservation
from sideslip.estimators.wires import SignalCalibration, read_wires
from sideslip.estimators.wrappers.truth import TruthObservation

OLD = Path(__file__).parent / "files/old"
YAW = "sideslip/YawVision-v0"
IDS = ("sideslip/AfsYawFusion-v0", "sideslip/YawVisionUneven-v0")
SHORT = {"base": "gust", "duration": 0.1}


def fields_of(kind: type) -> list[str]:
    """The names of a dataclass's or named tuple's fields."""
    if dataclasses.is_dataclass(kind):
        return [each.name for each in dataclasses.fields(kind)]
    return list(kind._fields)  # type: ignore[attr-defined]


def names_now() -> dict[str, list[str]]:
    """The names of today that stand in files, on wires, in specs and in `info`."""
    layout, info = set[str](), set[str]()
    for env_id in IDS:
        env = EstimateObservation(gym.make(env_id), "exact-kf" if "Uneven" not in env_id else "lob")
        base: Any = env.unwrapped
        layout |= {entry.name for entry in base.layout}
        info |= {*env.reset(seed=0)[1], *env.step(env.action_space.sample())[-1]}
    calibration = sideslip.benchmarks.control.calibration
    return {
        "policy card": fields_of(sideslip.agents.learned.policy.Card),
        "network": list(load_policy(list_shipped()[0]).network.description),
        "scenario": fields_of(Scenario),
        "vehicle": fields_of(Vehicle),
        "wires": [*WIRE_TABLES, *fields_of(SignalCalibration)],
        "camera": fields_of(Pinhole),
        "log columns": list(COLUMNS),
        "rows": fields_of(ResultRow),
        "contests": fields_of(TaskMeasurement),
        "calibration": [
            *fields_of(calibration.CalibrationRecord),
            *fields_of(calibration.ClairvoyantEpisode),
        ],
        "baselines": fields_of(sideslip.benchmarks.entrants.challenge.BaselineRecord),
        "session": list(controller._SETUP),
        "datagrams": [name for kind in messages.FIELDS.values() for name in kind],
        "info": sorted(info),
        "layout": sorted(layout),
        "drive": list(rollout(gym.make(YAW, scenario=SHORT), None, 0).columns),
        "specs": sorted(
            {str(spec.entry_point) for spec in gym.registry.values() if "sideslip/" in spec.id}
            | {
                str(spec.vector_entry_point)
                for spec in gym.registry.values()
                if "sideslip/" in spec.id
            }
        ),
    }


def test_names_that_stand_in_files_are_what_they_were() -> None:
    kept, now = json.loads((OLD / "names.json").read_text()), names_now()
    assert {kind: sorted({*names} - {*now[kind]}) for kind, names in kept.items()} == {
        kind: [] for kind in kept
    }
    assert kept.keys() == now.keys()


def test_a_scenario_a_vehicle_with_its_wires_and_a_camera_are_read() -> None:
    noisy = {"base": "gust", "duration": 0.5, "noise": {"gyro": 0.01}}
    assert make_scenario(OLD / "scenario.toml") == make_scenario(noisy)
    car, coms = make_vehicle(OLD / "vehicle.toml").to_dict(), make_vehicle("coms").to_dict()
    coms["relaxation"] = PASSENGER_CAR.relaxation  # younger than the file
    assert car == pytest.approx(coms, nan_ok=True)
    assert read_wires(OLD / "vehicle.toml") == SignalCalibration(
        15.2, -1, 0.01, {"gps": 0.2}, {"gyro_noise": 0.01}
    )
    camera = Pinhole.read(OLD / "camera.json")
    assert (camera.K[0], camera.size) == ((800.0, 0.0, 320.0), (640, 480))


def test_rows_and_a_session_are_read() -> None:
    row = ResultRow(
        "control", "tier 1", "cost_vs_nominal", 0.5, "", "none", 0.4, 0.6, 12, salt="ab12"
    )
    assert read_json(OLD / "rows.json") == [row]
    assert controller.read_setup(OLD / "session.slip")["estimator"] == "exact-kf"
    ((batches, _),) = controller.read_blocks(OLD / "session.slip")
    found = [messages.decode(arrival.data) for batch in batches for arrival in batch]
    kinds = [getattr(each, "kind", each) for each in found]
    assert kinds == [messages.DatagramKind.INERTIAL, messages.DatagramKind.END]


@pytest.mark.parametrize(
    ("file", "wrapper"),
    [("estimate-spec.json", EstimateObservation), ("truth-spec.json", TruthObservation)],
)
def test_a_spec_makes_its_environment(file: str, wrapper: type) -> None:
    text = (OLD / file).read_text()
    env = gym.make(EnvSpec.from_json(text))
    assert isinstance(env, wrapper)
    assert env.get_wrapper_attr("scenario").name == "gust" and env.spec is not None
    assert json.loads(env.spec.to_json())["kwargs"] == json.loads(text)["kwargs"]


def test_what_the_package_ships_is_read() -> None:
    assert all(load_policy(name).card.env_id for name in list_shipped())
    assert _read_tasks() and _read_baselines() and read_tuned()


@pytest.mark.parametrize(("algo", "action"), [("ppo", 0.012264779), ("gradient", -0.5908138)])
def test_a_zip_that_names_modules_and_classes_still_drives(algo: str, action: float) -> None:
    pytest.importorskip("stable_baselines3")
    env: Any = gym.make(YAW)
    agent = make_agent(str(OLD / f"{algo}.zip"), env, trust=True)
    first, _ = agent.predict(np.ones(env.observation_space.shape, np.float32))
    assert first == pytest.approx([action], abs=1e-6)


def test_a_training_goes_on_from_its_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("stable_baselines3")
    from sideslip.agents.training import callbacks
    from sideslip.agents.training.trainer import Trainer

    folder = shutil.copytree(OLD / "training", tmp_path / "training")
    monkeypatch.setattr(callbacks, "__version__", "0.2.0")
    saved = callbacks.read_training(folder)
    found = Trainer(saved.task, saved.steps, folder, resume=True).train()
    assert [each.steps for each in found.evaluations] == [0, 16]
    assert found.model.num_timesteps == 16
