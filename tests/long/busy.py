"""``python -m tests.long.busy RUNS``: run the whole suite, each time beside at least four busy processes.

Three suites run at once, so that each is beside the workers of two others. Processes that only compute take the place
of suites that are missing in the last group. Output is in ``build/busy-K.txt``.
"""

import multiprocessing
import os
import subprocess
import sys
from pathlib import Path

BUSY, AT_ONCE, JOBS = 4, 3, int(os.environ.get("JOBS", "3"))
COMMAND = f"{sys.executable} -m pytest -p no:cacheprovider --dist loadfile --no-loadscope-reorder --numprocesses {JOBS}"


def spin() -> None:
    while True:
        pass


def run(numbers: range) -> list[int]:
    """Run suites at once, and return the numbers of those that failed."""
    others = JOBS * (len(numbers) - 1)
    busy = [multiprocessing.Process(target=spin, daemon=True) for _ in range(BUSY - others)]
    for process in busy:
        process.start()
    folder = Path("build")
    folder.mkdir(exist_ok=True)
    suites = []
    for k in numbers:
        with (folder / f"busy-{k}.txt").open("wb") as output:
            suites.append(subprocess.Popen(COMMAND.split(), stdout=output, stderr=subprocess.STDOUT))
    failed = [k for k, suite in zip(numbers, suites, strict=True) if suite.wait()]
    for process in busy:
        process.kill()
    return failed


def main(runs: int) -> int:
    """Return 1 if a run fails."""
    failed = [k for first in range(0, runs, AT_ONCE) for k in run(range(first, min(first + AT_ONCE, runs)))]
    for k in failed:
        sys.stdout.write(Path(f"build/busy-{k}.txt").read_text()[-4000:])
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))
