"""Each way to type a command wrong: one line that names the mistake, and no file."""

from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from tests.benchmarks.conftest import Run
from tests.policies import VISION

LQR = ("run", "--agent", "lqr", "--estimator", "exact-kf")
SCENARIO = "tie-vision-fig8"
TUNE = ("tune", "estimator", "--seeds", 1, "--test-seeds", 2, "--jobs", 1)
LAW, DISTIL = ("tune", "controller"), ("distill", "mine", "--class")
FIG8 = (*TUNE, "bicycle-kf", "--scenario", SCENARIO)


@cache
def make_cached_simulation() -> Callable[[Any], Any]:
    """Simulate each drive of a tuning once for all tests."""
    from sideslip.benchmarks.tuning import estimator

    return cache(estimator._simulate_case)


NEEDS = {"distill": "torch", "train": "stable_baselines3", "tune": "optuna"}
MISTAKES: list[tuple[tuple[object, ...], str]] = [
    (("run", "--video", "film.avi"), "a film ends in .mp4 or .gif, got 'film.avi'"),
    (("run", "--beside", "none"), "'none' can only drive beside in a film: --video"),
    (("enjoy", VISION, "--video", "film.avi"), "a film ends in .mp4 or .gif"),
    (("run", "--scenario", "moon"), "unknown scenario 'moon'"),
    (("run", "--agent", "pid"), "unknown agent 'pid'"),
    (("run", "sideslip/YawVision-v0", "--estimator", "dakf"), "dakf needs the slow sensor gps"),
    (("run", "--agent", "two-dof"), "add --estimator, for example --estimator exact-kf"),
    (("run", "--agent", "lqr"), "lqr works on an estimate: add --estimator"),
    (("run", "--agent", "lqrr"), "unknown agent 'lqrr'; did you mean 'lqr'"),
    (("run", "YawVison-v0"), "did you mean 'sideslip/YawVision-v0'"),
    (("run", "--scenario", "gusts"), "unknown scenario 'gusts'; did you mean 'gust'"),
    (("run", "--scenario", "nowhere.toml"), "nowhere.toml: there is no such scenario file"),
    (("run", "--vehicle", "comms"), "unknown vehicle 'comms'; did you mean 'coms'"),
    (("run", "--vehicle", "nowhere.toml"), "nowhere.toml: there is no such vehicle file"),
    (("run", "--option", "reverence=model"), "'reverence'; did you mean 'reference'?"),
    (
        ("run", "--option", "seed=1", "--option", "seed=[2]"),
        "option seed is there twice, as 1 and '[2]'",
    ),
    (
        ("run", "--control-period", "20", "--option", "control_period=5"),
        "is there twice, as a flag",
    ),
    (("run", "--option", "reference"), "an option is NAME=VALUE, got 'reference'"),
    ((*LQR, "--agent-option", "grib=1"), "lqr: unknown option 'grib'; did you mean 'grip'"),
    ((*LQR, "--estimator-option", "q_bta=1"), "unknown option 'q_bta'; did you mean 'q_beta'"),
    (("run", "--estimator-option", "q_beta=1"), "--estimator-option needs --estimator"),
    (("run", "--plot", "drive.txt"), "drive.txt: expected a file that ends in .png or"),
    (("bench", "--html", "report.json"), "report.json: expected a file that ends in .html"),
    (("calibrate", "costs.toml"), "costs.toml: expected a file that ends in .json"),
    (("train", "--env", "YawVison-v0"), "did you mean 'sideslip/YawVision-v0'"),
    (("run", "--scenario", "gust.txt"), "gust.txt: the file of a scenario ends in .toml or"),
    (("list", "scenario"), "unknown kind of name 'scenario'; did you mean 'scenarios'"),
    (("bench", "weather"), "unknown suite 'weather'; known: estimation"),
    (("enjoy", VISION, "--parquet", "rows.txt"), "a file that ends in .parquet"),
    (("enjoy", "nobody"), "unknown policy 'nobody'; known: distill-car-"),
    (("enjoy", VISION, "--env", "sideslip/YawGps-v0", "--episodes", 2), "camera_psi"),
    (("enjoy", VISION, "--scenario", "moon"), "unknown scenario 'moon'"),
    (("enjoy", VISION, "--html", "nowhere/report.html"), "no such folder"),
    (("enjoy", VISION, "--episodes", 0), "greater than or equal to 1"),
    (("bench", "speed", "--json", "nowhere/rows.json"), "cannot write nowhere/rows.json"),
    (("bench", "control", "--fresh"), "go with --agent or --estimator"),
    (("bench", "control", "--vehicle", "coms"), "--vehicle go with --agent or --estimator"),
    (("bench", "papers", "--keep", "cases"), "--keep goes with the suite control, got papers"),
    (("bench", "papers", "--data", "."), "--data goes with the suite logs, got papers"),
    (("bench", "highway", "--episodes", "4"), "highway has a number of its own"),
    (("bench", "papers", "--agent", "esc"), "go with the suite control alone"),
    (("bench", "--estimator", "none"), "goes with --agent"),
    (("bench", "papers", "--salt", "ab12"), "--salt goes with control, got"),
    (("bench", "control", "--salt", "xyz"), "a salt is hexadecimal digits, got 'xyz'"),
    (("replay", "nowhere.csv", "--parquet", "rows.txt"), "a file that ends in .parquet"),
    (("replay", "nowhere.csv"), "nowhere.csv"),
    (("inspect", "nowhere.csv", "--html", "page.txt"), "a file that ends in .html"),
    (("replay", "nowhere.nmea"), "nowhere.nmea: there is no such file"),
    (("replay", "nowhere.csv", "--kml", "a.kml"), "--kml are for a receiver's log"),
    (("calibrate", "--contest", "moon"), "unknown task 'moon'"),
    (("calibrate", "--seeds", "1"), "two seeds or more, got 1"),
    (("calibrate", "nowhere/mine.json"), "cannot write nowhere/mine.json"),
    (("live",), "name an ESTIMATOR, or --simulate, --relay or --replay"),
    (("live", "exact-kff", "--port", "0"), "did you mean 'exact-kf'?"),
    (("live", "exact-kf", "--port", "0", "--agent", "lqrr"), "did you mean 'lqr'?"),
    (("live", "exact-kf", "--publish", "nowhere"), "HOST:PORT"),
    (("live", "exact-kf", "--host", "192.0.2.1"), "is none"),
    (("live", "exact-kf", "--json", "a.txt"), "ends in .json"),
    (("live", "exact-kf", "--to", "127.0.0.1:9"), "to: of no use to an ESTIMATOR: see --publish"),
    (("live", "exact-kf", "--relay", "log.nmea"), "estimator: of no use to --relay"),
    (("live", "--simulate", "--agent", "lqr"), "agent: of no use to --simulate without an EST"),
    (("live", "--simulate", "--json", "a.json", "--record", "a"), "json, record: of no use to"),
    (("lane", "--calibrate", ".", "--out", "camera.json"), "out: of no use to --calibrate"),
    (("live", "--replay", "a", "--record", "b", "--seed", "1"), "record, seed: of no use to --rep"),
    (("live", "--simulate", "--env", "sideslip/YawVison-v0"), "did you mean"),
    (("live", "--relay", "no-such-file"), "no-such-file"),
    (("live", "exact-kf", "--port", "0", "--gps", "tcp:nowhere"), "expected tcp:HOST:PORT"),
    (("live", "--replay", "no-such-file"), "no-such-file"),
    (("live", "--replay", __file__), "is no session"),
    (("live", "exact-kf", "--port", "0", "--record", __file__), "exists"),
    (("train", "--algo", "dqn"), "unknown algorithm 'dqn'; known: ppo"),
    (("train", "--env", "sideslip/Yaw-v0"), "Yaw"),
    (("train", "--env", "Pendulum-v1"), "Pendulum-v1 has no native vector env"),
    (("train", "--estimator", "dakf"), "dakf needs the slow sensor gps"),
    (("train", "--option", "scenario=moon"), "unknown scenario 'moon'"),
    (("train", "--resume"), "holds no training to go on with"),
    (("train", "--resume", "--varied", 2), "varied 2 is for a new training"),
    (("train", "--device", "moon"), "cpu, cuda or another of torch's, or auto, got 'moon'"),
    (("train", "--steps", "0"), "steps is at least 1, got 0"),
    (("train", "--num-envs", "0"), "greater than or equal to 1"),
    (("train", "--seed", "-1"), "seed is at least 0, got -1"),
    (("train", "--scenarios", "moon"), "scenario 0 of the mixture: unknown scenario 'moon'"),
    ((*DISTIL, "coms"), "unknown class of tasks 'coms'; known: coms-model"),
    ((*DISTIL, "coms-model", "--estimator", "dakf"), "unknown estimator 'dakf'"),
    ((*DISTIL, "coms-model", "--teacher", "oracle"), "unknown agent 'oracle'"),
    ((*DISTIL, "coms-model", "--teacher", "lane-keeping"), "needs psi_hat, y_l_hat"),
    ((*DISTIL, "coms-model", "--rounds", 0), "1 at least"),
    ((*DISTIL, "coms-model", "--option", "map=true"), "unknown option 'map'"),
    ((*LAW, "kalman"), "unknown controller 'kalman'; known: two-dof, "),
    ((*LAW, "lqr", "--class", "moon"), "unknown class 'moon'; known: coms-model, "),
    ((*LAW, "lqr", "--class", "coms-model", "--trials", 0), "trials must be at least 1, got 0"),
    ((*LAW, "lqr", "--class", "coms-model", "--seeds", 0), "0 seeds; both are needed"),
    ((*LAW, "model-following", "--class", "car-yaw"), "needs an env whose action steers"),
    ((*LAW, "lqr", "--out", "nowhere/tuned.toml"), "nowhere/tuned.toml"),
    ((*TUNE, "kalman", "--scenario", SCENARIO), "unknown estimator 'kalman'"),
    ((*TUNE, "dafk", "--scenario", SCENARIO), "did you mean 'dakf'"),
    ((*TUNE, "dakf", "--scenario", "moon"), "unknown scenario 'moon'"),
    ((*TUNE, "dakf", "--scenario", "sine", "--env", "sideslip/YawVision-v0"), "slow sensor gps"),
    ((*TUNE, "dakf", "--scenario", "sine", "--env", "sideslip/Nowhere-v0"), "Nowhere"),
    ((*FIG8, "--trials", "0"), "trials must be at least 1, got 0"),
    ((*FIG8, "--seeds", "0"), "seeds must be at least 1, got 0"),
    ((*FIG8, "--test-seeds", "0"), "test seeds are 1 to 1000, got 0"),
    ((*FIG8, "--target", "phi"), "bicycle-kf has no phi; a target is one of beta, gamma"),
    ((*FIG8, "--sampler", "grid"), "unknown sampler 'grid'; known: cma, tpe"),
    ((*FIG8, "--option", "q_beta"), "an option is NAME=VALUE, got 'q_beta'"),
    ((*FIG8, "--option", "colour=red"), "bicycle-kf: unknown option 'colour'"),
    ((*FIG8, "--search", "q_psi"), "bicycle-kf: unknown option 'q_psi'"),
    ((*FIG8, "--search", "q_beta=1"), "NAME or NAME=LOW:HIGH, got 'q_beta=1'"),
    ((*FIG8, "--search", "q_beta=2:1"), "0 < LOW < HIGH, got 2.0:1.0"),
    ((*FIG8, "--option", "q_beta=1", "--search", "q_beta"), "both given and searched"),
    ((*FIG8, "--option", "dt=0.002"), "dt is the environment's, no option"),
    ((*FIG8, "--search", "dt"), "both given and searched"),
    ((*FIG8, "--noise", "gyro_noise", "--write"), "--out writes the others"),
    ((*FIG8, "--storage", "sqlite:////nowhere/at/all.db"), "unable to open database file"),
    ((*FIG8, "--storage", "moon://user:secret@host/x"), "failed (moon://user:***@host/x"),
    ((*FIG8, "--out", "nowhere/found.toml"), "nowhere/found.toml"),
]


@pytest.mark.parametrize(("arguments", "said"), MISTAKES)
def test_a_mistake_is_one_line_that_names_it(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[object, ...],
    said: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    if (needed := NEEDS.get(str(arguments[0]))) and find_spec(needed) is None:
        pytest.skip(f"needs {needed}")
    if arguments[0] == "tune":
        name = "sideslip.benchmarks.tuning.estimator._simulate_case"
        monkeypatch.setattr(name, make_cached_simulation())
    status, out, err = run(*arguments)
    assert status == 2
    assert said in " ".join(err.split()) and "secret" not in err and "Traceback" not in out + err
    left = {path.suffix for path in tmp_path.rglob("*") if path.is_file()}
    assert not left & {".safetensors", ".toml", ".json", ".csv", ".png", ".html"}
    assert arguments[0] != "tune" or err.count("\n") == 1
