"""Environments in other processes are the same."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ..helpers import IDS

SPAWN = """
import multiprocessing, pickle, sys
import gymnasium, numpy

def drive(env, name):
    env = env or gymnasium.make(name)  # an id of the form "module:id" imports the package
    obs, info = env.reset(seed=3)
    action = numpy.full(env.action_space.shape, 0.2, "f")
    rewards = [float(env.step(action)[1]) for _ in range(20)]
    return obs.tobytes(), rewards, sys.modules["sideslip.envs"].__name__

def work(sender, env, name):
    sender.send([drive(None, name), drive(env, name)])

if __name__ == "__main__":
    import sideslip
    for name in {ids}:
        here = drive(None, name)
        env = gymnasium.make(name).unwrapped
        env.reset(seed=1)
        receiver, sender = multiprocessing.Pipe()
        context = multiprocessing.get_context("{method}")
        worker = context.Process(target=work, args=(sender, env, "sideslip:" + name))
        worker.start()
        assert receiver.recv() == [here, here]
        worker.join()
        assert worker.exitcode == 0
    print("the same everywhere")
"""


def run(folder: Path, ids: tuple[str, ...], method: str) -> str:
    """Run the script in a fresh interpreter that finds the same `sideslip`."""
    path = folder / "script.py"
    path.write_text(SPAWN.replace("{ids}", repr(ids)).replace("{method}", method))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, str(path)], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.smoke
def test_a_spawned_process_makes_unpickles_and_drives_the_same(tmp_path: Path) -> None:
    assert run(tmp_path, IDS[:1], "spawn") == "the same everywhere"


@pytest.mark.long
@pytest.mark.parametrize("method", ["spawn", "forkserver", "fork"])
def test_so_does_every_id_and_way_of_starting(method: str, tmp_path: Path) -> None:
    assert run(tmp_path, IDS, method) == "the same everywhere"
