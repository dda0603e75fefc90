"""What reading an upload costs: a process that reads each in a child of its own, and tells memory and time.

``python -m tests.cost`` takes, again and again, a line of JSON with the length of a body and what it is said to be, and
the body; it answers with a line of JSON.
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

#: Seconds of a processor after which a child is ended.
SECONDS = 30
#: What a model asks for whose meshes are no larger.
LIMITS = Limits(2**15, 2**16)


def most_memory() -> int:
    """Most bytes that this process ever had in memory at once."""
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found
    return int(found[1]) * 1024


def read(body: bytearray, said: str) -> str:
    """What comes of a body: a sentence, or the mesh's size."""
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
            line += (one := os.read(0, 1))  # no more than the line: the body is for the child
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
    """Asks that process."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process

    def __call__(self, body: bytes, said: str) -> dict[str, Any]:
        """The memory that reading a body took beyond it, and what was said to it; or how its process ended."""
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.write(json.dumps({"length": len(body), "said": said}).encode() + b"\n")
        self._process.stdin.write(body)
        self._process.stdin.flush()
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        return answer


@contextmanager
def costs() -> Iterator[Costs]:
    """A process to ask."""
    root = Path(__file__).parents[1]
    with subprocess.Popen(
        [sys.executable, "-m", "tests.cost"], cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        yield Costs(process)
        assert process.stdin
        process.stdin.close()


if __name__ == "__main__":
    main()
