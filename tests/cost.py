"""Cost of reading uploads: a process that reads each in a child of its own, and reports memory and time.

``python -m tests.cost`` reads, repeatedly, a line of JSON with the length and declared format of a body, and
then the body; it answers with a line of JSON.
"""

from __future__ import annotations

import json
import os
import re
import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from shapespace.files.limits import Limits
from shapespace.service.use_cases.uploads import UploadError, read_mesh_file

#: Seconds of CPU time after which a child is killed.
SECONDS = 30
#: Limits for a model with meshes no larger than this.
LIMITS = Limits(2**15, 2**16)


def most_memory() -> int:
    """Peak resident memory of this process so far, in bytes."""
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found
    return int(found[1]) * 1024


def read(body: bytearray, said: str) -> str:
    """The result of reading a body: the error in a sentence, or the mesh's size."""
    try:
        form = "/" in said
        vertices, faces, *_ = read_mesh_file(body, said if form else "", None if form else said, LIMITS)
    except UploadError as error:
        return str(error)
    return f"{len(vertices)} vertices and {len(faces)} faces"


def answer(**facts: object) -> None:
    os.write(1, json.dumps(facts).encode() + b"\n")


def child(length: int, said: str) -> None:
    body = bytearray(length)
    with memoryview(body) as left:
        while left:
            left = left[os.readv(0, [left]) :]
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
    before = most_memory()
    sentence = read(body, said)
    answer(memory=most_memory() - before, said=sentence)


def main() -> None:
    while True:
        line = b""
        while not line.endswith(b"\n"):
            line += (one := os.read(0, 1))  # not beyond the line, as the child reads the body
            if not one:
                return
        process = os.fork()
        if not process:
            child(**json.loads(line))
            os._exit(0)
        _, status = os.waitpid(process, 0)
        if status:
            answer(ended=status)


class Costs:
    """Sends bodies to that process."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process

    def __call__(self, body: bytes, said: str) -> dict[str, Any]:
        """The memory that reading took in addition to the body, and its result; or how the child ended."""
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.write(json.dumps({"length": len(body), "said": said}).encode() + b"\n")
        self._process.stdin.write(body)
        self._process.stdin.flush()
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        return answer


@contextmanager
def costs() -> Iterator[Costs]:
    """Starts the process, and ends it afterwards."""
    root = Path(__file__).parents[1]
    with subprocess.Popen(
        [sys.executable, "-m", "tests.cost"], cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        yield Costs(process)
        assert process.stdin
        process.stdin.close()


if __name__ == "__main__":
    main()
