"""A policy of stable-baselines3 in the open benchmark."""

from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest

import sideslip
from sideslip.benchmarks.control.entries import ControlCase
from sideslip.benchmarks.control.tasks import YAW, ControlTask
from sideslip.benchmarks.entrants.challenge import ComparisonRequest, make_user_entries


@pytest.mark.long
def test_a_zip_drives_as_its_export_does(tmp_path: Path) -> None:
    """On the observation that it was trained on."""
    sb3 = pytest.importorskip("stable_baselines3")
    from sideslip.agents.training.export import export_zip
    from sideslip.agents.vec_env import make_vec_env

    zipped, exported = tmp_path / "mine.zip", tmp_path / "mine.safetensors"
    sb3.A2C("MlpPolicy", make_vec_env(YAW, 1), policy_kwargs={"net_arch": [4]}).save(zipped)
    export_zip(zipped, exported, YAW, trust=True)
    short = {"base": "gust", "duration": 0.3}
    options: dict[str, Any] = {"scenarios": short, "seeds": (1, 2), "jobs": 1, "estimator": ""}
    found = [
        sideslip.score(str(path), YAW, trust=path == zipped, **options)
        for path in (zipped, exported)
    ]
    assert not found[0].error and found[0].cost == found[1].cost


def test_a_zip_is_read_where_it_is_trusted(tmp_path: Path) -> None:
    """Alone, without a filter that it did not see in training."""
    mine = str(tmp_path / "mine.zip")
    with ZipFile(mine, "w") as archive:
        archive.writestr("data", "{}")
        archive.writestr("policy.pth", "")
    (pair, other) = make_user_entries([mine, "esc"], [], trust=True)
    assert pair.estimator == "" and ControlCase(ControlTask(), pair).options["controller"] == {
        "trust": True
    }
    assert not other.trust
    ComparisonRequest((pair,))
    with pytest.raises(PermissionError, match=r"`sideslip export .*mine.zip --trust`"):
        ComparisonRequest(tuple(make_user_entries([mine], [])))
