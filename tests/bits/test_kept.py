"""No number has changed: every drive of `drives.py` has the bits that are kept beside it.

It runs in a process of its own, whose BLAS is chosen before NumPy is loaded.
"""

import subprocess
import sys
from pathlib import Path


def test_every_drive_has_the_bits_that_were_kept() -> None:
    drives = Path(__file__).with_name("drives.py")
    ran = subprocess.run(
        [sys.executable, "-W", "ignore", str(drives)], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
