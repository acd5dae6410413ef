"""Classes in a user's files: which one is meant, what is wrong with a file, and where."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

from sideslip.agents import make_agent, register_agent
from sideslip.estimators import make_estimator
from sideslip.estimators.registry import _load_user_class, describe_error, find_class, is_user_file

AGENT = """
class Still:
    def __init__(self, env):
        self.env = env

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return [0.0], state
"""
FILTER = """
class Filter:
    names, x, P = ("beta", "gamma"), (0.1, 0.2), [[1.0, 0.0], [0.0, 1.0]]

    def __init__(self, **arguments):
        self.arguments = arguments

    def reset(self, sensors, first):
        pass

    def step(self, rows, packets):
        pass
"""


def file(folder: Path, text: str, name: str = "my.py") -> str:
    (folder / name).write_text(text)
    return str(folder / name)


def test_a_files_class_is_a_name(tmp_path: Path) -> None:
    """Of an agent and of an estimator; a registered one too; a file that imports nothing does."""
    mine, env = file(tmp_path, AGENT), gym.make("sideslip/YawVision-v0")
    for name in (mine, f"{mine}:Still"):
        agent: Any = make_agent(name, env)
        assert type(agent).__name__ == "Still"
        assert agent.env is env
    assert _load_user_class(mine) is _load_user_class(f"{mine}:Still")  # run once
    register_agent("still-of-a-file", f"{mine}:Still")
    assert type(make_agent("still-of-a-file", env)).__name__ == "Still"
    own = make_estimator(f"{file(tmp_path, FILTER, 'my-filter.py')}:Filter", dt=0.002)
    assert own.names == ("beta", "gamma") and own.dt == 0.002


def test_another_text_is_another_class_and_neighbours_are_found(tmp_path: Path) -> None:
    mine = file(tmp_path, "from my_neighbour import GAIN\n\n\ndef build(env):\n    return GAIN\n")
    file(tmp_path, "GAIN = 3\n", "my_neighbour.py")
    assert _load_user_class(f"{mine}:build")(None) == 3
    file(tmp_path, "def build(env):\n    return 4\n")
    assert _load_user_class(f"{mine}:build")(None) == 4


BAD = {
    "no class": ("GAIN = 3\n", "", "say what of .*my.py is meant, .* it defines no class"),
    "nothing": ("", "", "it defines no class"),
    "two classes": (AGENT + FILTER, "", r"as .*my.py:NAME; it defines Still, Filter"),
    "another class": (AGENT, ":Stil", "my.py has no 'Stil'; it defines Still"),
    "no Python": ("class Still:\n    def :\n", "", "my.py, line 2: invalid syntax"),
    "null bytes": ("\0", "", "my.py"),
    "raises": ("class A:\n    x = np.zeros(3)\n", "", "NameError: name 'np' is .* line 2"),
    "another type": ("GAIN = 3\n", ":GAIN", "no class or function but of type int"),
    "gone": ("class A: ...\n\n\ndel A\n", "", "my.py has no 'A' once it is run"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_file_that_has_no_class_for_us_is_refused(case: str, tmp_path: Path) -> None:
    text, name, message = BAD[case]
    with pytest.raises((ValueError, TypeError), match=message):
        _load_user_class(file(tmp_path, text) + name)


def test_what_is_found_is_not_run(tmp_path: Path) -> None:
    mine = file(tmp_path, "class A: ...\n\n\nraise SystemExit\n")
    assert find_class(mine) == (Path(mine), "A")
    with pytest.raises(FileNotFoundError, match=r"there is no file .*other\.py"):
        find_class(str(tmp_path / "other.py:A"))


@pytest.mark.parametrize("text", ["package.module:Name", "lqr", "x.zip", "a.safetensors", "py:A"])
def test_other_names_are_no_files(text: str) -> None:
    assert not is_user_file(text)


def test_a_reason_has_the_line_of_the_users_file(tmp_path: Path) -> None:
    build = _load_user_class(
        file(tmp_path, "def build(x):\n    y = 1\n    return y / x\n") + ":build"
    )
    with pytest.raises(ZeroDivisionError) as caught:
        build(0)
    assert describe_error(caught.value) == "ZeroDivisionError: division by zero (my.py, line 3)"
    assert describe_error(ValueError("ours")) == "ValueError: ours"
