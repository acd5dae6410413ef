"""A zip on the command line: exported, driven, or refused in a line."""

from pathlib import Path

import pytest

from sideslip.agents.learned.policy import load_policy
from sideslip.agents.vec_env import make_vec_env
from tests.benchmarks.conftest import Run

sb3 = pytest.importorskip("stable_baselines3")
HERE, GPS = "sideslip/YawVision-v0", "sideslip/YawGps-v0"


@pytest.fixture
def zipped(tmp_path: Path) -> Path:
    path = tmp_path / "mine.zip"
    env = make_vec_env(GPS, 1, estimator="bicycle-kf")
    sb3.SAC("MlpPolicy", env, policy_kwargs={"net_arch": [8, 4]}, buffer_size=10).save(path)
    return path


def test_a_zip_is_exported_and_drives(run: Run, zipped: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.safetensors"
    trained = ("--env", GPS, "--estimator", "bicycle-kf")
    status, out, err = run("export", zipped, "-o", other, "--trust", *trained)
    assert status == 0, err
    assert (
        "x 8 x 4 x 1" in out
        and "normalised by: the scales of its training" in out
        and str(other) in out
    )
    card = load_policy(other).card
    assert card.estimator == "bicycle-kf" and card.env_id == GPS
    for file, trust in ((other, ()), (zipped, ("--trust",))):
        status, out, err = run("run", GPS, "--agent", file, "--estimator", "bicycle-kf", *trust)
        assert status == 0 and "cost" in out, err


def test_enjoy_takes_a_zip(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "mine.zip"
    sb3.PPO("MlpPolicy", make_vec_env(HERE, 1), policy_kwargs={"net_arch": [8]}).save(path)
    status, out, err = run("enjoy", path, "--trust", "--episodes", 2, "--scenario", "gust")
    assert status == 0 and "mine" in out and "lqr on exact-kf" in out, err
    status, out, err = run("enjoy", path, "--trust", "--card")
    assert status == 0 and "22 x 8 x 1" in out and "ActorCriticPolicy" in out, err
    assert [each.name for each in tmp_path.iterdir()] == ["mine.zip"]


def test_a_mistake_is_one_line(run: Run, zipped: Path, tmp_path: Path) -> None:
    cases: list[tuple[tuple[object, ...], str]] = [
        (("export", zipped), "--trust"),
        (("run", "--agent", zipped), "--trust"),
        (("enjoy", zipped), "--trust"),
        (("export", tmp_path / "none.zip", "--trust"), "no such file"),
        (("export", zipped, "--trust"), "the observation here has 22: gyro,"),
        (("export", zipped, "--trust", "-o", tmp_path / "x.zip"), "NAME.safetensors, got"),
    ]
    for arguments, named in cases:
        status, out, err = run(*arguments)
        assert status == 2 and named in " ".join(err.split()), (arguments, err)
        assert "Traceback" not in out + err
