"""Scenarios from files: what is written is read back, and what is out of place is refused."""

from pathlib import Path

import pytest

from sideslip.envs import SCENARIOS, Scenario, StabilityEnv, make_scenario

pytestmark = pytest.mark.plain

ODD = Scenario(
    name='a "name" \\ with\tall\x7f \u00e9\U0001f600',
    steering="trace",
    trace=(0.0, -1e-17, 0.1 + 0.2),
    speed=(5.0, 6.0),
    camera_heading=0.5,
    mirror=True,
    noise={"gyro": 1e-300},
    vehicle={"mass": 400},
)


@pytest.mark.parametrize("ending", ["toml", "json"])
def test_what_is_written_is_read_back(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"it.{ending}"
    for scenario in (*SCENARIOS.values(), ODD):
        scenario.write(path)
        assert make_scenario(path) == make_scenario(str(path)) == scenario


def test_a_file_starts_from_a_name_or_a_file_beside_it(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('base = "gust"\nspeed = [4.0, 5.0]\n')
    (tmp_path / "other.json").write_text('{"base": "mine.toml", "friction": 0.5, "name": "o"}')
    mine, other = (make_scenario(tmp_path / name) for name in ("mine.toml", "other.json"))
    assert mine == SCENARIOS["gust"].replace(name="mine", speed=(4.0, 5.0))
    assert other == mine.replace(name="o", friction=0.5)
    env = StabilityEnv(scenario=str(tmp_path / "mine.toml"))
    env.reset(seed=0, options={"scenario": tmp_path / "other.json"})
    assert env.scenario == other


@pytest.mark.parametrize(
    ("content", "error", "message"),
    [
        ("speed = ", ValueError, "expected TOML, but"),
        ("speeed = 5.0", TypeError, "unknown scenario field 'speeed'; did you mean 'speed'"),
        ('base = "gusts"', ValueError, "unknown scenario 'gusts'; did you mean 'gust'"),
        ('steering = "driven"', ValueError, "unknown steering 'driven'; did you mean 'driver'"),
        ("speed = -1.0", ValueError, "speed must not be negative"),
        ('steering = "trace"', ValueError, "trace has 2 to 1000000 angles"),
        ("trace = [0.1, 0.2]", ValueError, "trace has 2 to 1000000 angles"),
        ('steering = "trace"\ntrace = [0.1, nan]', ValueError, "trace is angles in rad, finite"),
        ('steering = "trace"\ntrace = [0, 1]\ntrace_step = 0', ValueError, "trace_step is 0.001"),
        ('base = "bad.toml"', ValueError, "its base is the file itself"),
        ('base = "good.toml"', ValueError, "its base is the file itself, or leads back to it"),
        ("", ValueError, "holds nothing"),
    ],
)
def test_a_bad_file_is_refused(
    tmp_path: Path, content: str, error: type[Exception], message: str
) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(content)
    (tmp_path / "good.toml").write_text('base = "bad.toml"')
    with pytest.raises(error, match=message) as caught:
        make_scenario(path)
    assert str(path) in str(caught.value)


def test_what_is_no_scenario(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nowhere\.toml: there is no such scenario file"):
        make_scenario("nowhere.toml")
    with pytest.raises(FileNotFoundError, match=r"nowhere\.csv"):
        make_scenario("nowhere.csv")
    with pytest.raises(ValueError, match=r"ends in \.toml or \.json"):
        make_scenario(tmp_path / "drive.txt")
    with pytest.raises(ValueError, match=r"ends in \.toml or \.json"):
        ODD.write(tmp_path / "it.yaml")
    with pytest.raises(TypeError, match="a scenario is a name, the path of"):
        make_scenario(5)  # type: ignore[arg-type]
