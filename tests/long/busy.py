"""``python -m tests.long.busy RUNS``: run the whole suite beside four processes that keep the processors busy."""

import multiprocessing
import os
import subprocess
import sys

BUSY = 4


def spin() -> None:
    while True:
        pass


def main(runs: int) -> bool:
    """Whether every run passes."""
    busy = [multiprocessing.Process(target=spin, daemon=True) for _ in range(BUSY)]
    for process in busy:
        process.start()
    command = [sys.executable, "-m", "pytest", "-q", "--dist", "loadfile", "--no-loadscope-reorder"]
    command += ["--numprocesses", os.environ.get("JOBS", "3")]
    good = [subprocess.run(command, check=False).returncode == 0 for _ in range(runs)]
    return all(good)


if __name__ == "__main__":
    sys.exit(not main(int(sys.argv[1])))
