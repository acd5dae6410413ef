"""`sideslip live`: both ends, sessions, and each way to ask for what cannot be."""

import json
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from sideslip.agents.learned.policy import load_policy
from sideslip.agents.vec_env import make_vec_env
from tests.benchmarks.conftest import Run

BOTH = ("live", "exact-kf", "--agent", "lqr", "--simulate", "--port", 0)


@pytest.fixture
def short(tmp_path: Path) -> Path:
    path = tmp_path / "short.toml"
    path.write_text('base = "gust"\nduration = 0.3\n')
    return path


def test_both_ends_in_lock_step_and_their_session(run: Run, short: Path, tmp_path: Path) -> None:
    session, numbers = tmp_path / "a.session", tmp_path / "a.json"
    files = "--record", session, "--json", numbers
    status, out, _ = run(*BOTH, "--step", "--scenario", short, *files)
    assert status == 0 and "exact-kf: 301 ticks" in out and "the drive is over" in out
    assert "The drive is the offline one bit for bit; 0 of 30 controls late." in out
    found = json.loads(numbers.read_text())
    assert found["same"] and found["ticks"] == 301 and found["counts"]["lost"] == 0
    status, out, _ = run("live", "--replay", session)
    assert status == 0 and "301 ticks; the estimates are those of the session bit for bit" in out
    status, _, err = run("live", "dakf", "--replay", session)
    assert status == 2 and "is of estimator exact-kf, not dakf" in err


def test_in_real_time_what_was_measured_is_printed(run: Run, short: Path, tmp_path: Path) -> None:
    numbers = tmp_path / "a.json"
    status, out, _ = run(*BOTH, "--scenario", short, "--json", numbers, "--page", 0, "--speed", 0.1)
    assert status == 0 and "page: http://127.0.0.1:" in out and "deadlines missed" in out
    assert len(out[out.index("exact-kf:") : out.index("wrote")].splitlines()) <= 5
    found = json.loads(numbers.read_text())
    assert found["deadlines"] > 100 and set(found["latency_us"]) == {"median", "p999", "max"}


def test_ctrl_c_ends_with_the_summary_and_a_whole_session(run: Run, tmp_path: Path) -> None:
    session = tmp_path / "a.session"
    command = [sys.executable, "-W", "ignore", "-m", "sideslip", *map(str, BOTH)]
    with subprocess.Popen([*command, "--record", str(session)], stdout=subprocess.PIPE) as both:
        assert both.stdout is not None and b"listening on 127.0.0.1:" in both.stdout.readline()
        while session.stat().st_size < 20_000:
            assert both.poll() is None
        both.send_signal(signal.SIGINT)
        out = both.stdout.read().decode()
    assert both.returncode == 0 and ", stopped" in out and f"wrote {session}" in out
    status, out, _ = run("live", "--replay", session)
    assert status == 0 and "those of the session bit for bit" in out


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"estimator": "mine.py:Mine"}, "name it in the command"),
        ({"agent": "mine.py:Mine"}, "name it in the command"),
        ({"env": "mine:Car-v0"}, "'mine:Car-v0', which names a module"),
        ({"estimator_options": {"estimator": "mine.py:Mine"}}, "holds an estimator"),
    ],
)
def test_a_session_may_not_choose_code(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: Any, said: str
) -> None:
    from sideslip.agents.live.controller import Recorder

    session = tmp_path / "a.session"
    (tmp_path / "mine.py").write_text("raise SystemExit('it ran')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    setup: dict[str, Any] = {key: {} for key in ("options", "agent_options", "estimator_options")}
    setup |= {"estimator": "dakf", "agent": "none", "env": "sideslip/YawGps-v0"}
    Recorder(session, setup | {"seed": 0, "patience": None} | change).close()
    status, _, err = run("live", "--replay", session)
    assert status == 2 and said in err and "it ran" not in err


def test_a_port_in_use_is_one_line(run: Run) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        number = other.getsockname()[1]
        status, _, err = run("live", "exact-kf", "--port", number)
    assert status == 2 and f"UDP port {number} of 127.0.0.1 is in use" in err


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
    status, out, err = run("enjoy", other, "--card")
    assert status == 0 and "x 8 x 4 x 1" in out and "bicycle-kf" in out, err
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
        (
            ("enjoy", "distill-coms-yaw", "--card", "--json", tmp_path / "x.json"),
            "json: of no use to --card",
        ),
        (("export", tmp_path / "none.zip", "--trust"), "no such file"),
        (("export", zipped, "--trust"), "the observation here has 22: gyro,"),
        (("export", zipped, "--trust", "-o", tmp_path / "x.zip"), "NAME.safetensors, got"),
    ]
    for arguments, named in cases:
        status, out, err = run(*arguments)
        assert status == 2 and named in " ".join(err.split()), (arguments, err)
        assert "Traceback" not in out + err
