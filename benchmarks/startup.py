"""How long the program takes to start: python benchmarks/startup.py.

Each line is the median wall time of 15 fresh processes, the bare interpreter's beside it. The aim
is 0.3 s for importing the package and 0.5 s for `--help`.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from statistics import median

REPEATS = 15
PROGRAM = Path(sys.executable).with_name("mbds-xsim")
COMMANDS = {
    "python -c pass": [sys.executable, "-c", "pass"],
    "import mbds_xsim": [sys.executable, "-c", "import mbds_xsim"],
    "mbds-xsim --help": [str(PROGRAM), "--help"],
    "mbds-xsim validate --help": [str(PROGRAM), "validate", "--help"],
    "mbds-xsim scenes": [str(PROGRAM), "scenes"],
    "mbds-xsim engines": [str(PROGRAM), "engines"],
}


def seconds(command: list[str]) -> float:
    begin = time.perf_counter()
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - begin


if __name__ == "__main__":
    for name, command in COMMANDS.items():
        seconds(command)  # compiles what has no bytecode yet
        print(f"{name:28} {median(seconds(command) for _ in range(REPEATS)):.3f} s")
