"""Tasks for a sandbox: good ones, and ones that break their process."""

import ctypes
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from shapespace.service.refusals import RefusedError

Answer = tuple[dict[str, Any], dict[str, np.ndarray]]
_kept: list[bytes] = []


def perform(body: bytearray, task: str, **facts: Any) -> Answer:
    """Do one of the tasks below."""
    return globals()[task](body, **facts)


def echo(body: bytearray, **facts: Any) -> Answer:
    return facts | {"pid": os.getpid()}, {"body": np.frombuffer(body, np.uint8)}


def double(body: bytearray) -> Answer:
    numbers = np.frombuffer(body, "<f8").reshape(-1, 2)
    return {}, {"twice": 2 * numbers, "turned": np.asfortranarray(numbers), "none": np.zeros((0, 3), np.int32)}


def about(body: bytearray, file: str) -> Answer:
    try:
        Path(file).write_text("x")
        written = bool(Path(file).stat().st_size)
    except OSError:
        written = False
    settings = [name for name in os.environ if name.startswith("SHAPESPACE_")]
    streams = [os.readlink(f"/proc/self/fd/{k}") for k in range(3)]
    return {"settings": settings, "streams": streams, "written": written, "path": sys.path}, {}


def refuse(body: bytearray) -> Answer:
    raise RefusedError("nonsense", "It is\nno mesh.")


def mistake(body: bytearray) -> Answer:
    return {}["missing"], {}


def wait(body: bytearray) -> Answer:
    time.sleep(1e6)
    return {}, {}


def spin(body: bytearray) -> Answer:
    while True:
        pass


def hold(body: bytearray) -> Answer:
    """Never release the interpreter lock."""
    ctypes.PyDLL(None).pause()
    return {}, {}


def crash(body: bytearray) -> Answer:
    ctypes.string_at(0)
    return {}, {}


def leave(body: bytearray) -> Answer:
    sys.exit(3)


def kill(body: bytearray) -> Answer:
    os.kill(os.getpid(), signal.SIGKILL)
    return {}, {}


def take(body: bytearray, size: int) -> Answer:
    return {"taken": len(bytearray(size))}, {}


def keep(body: bytearray, size: int) -> Answer:
    _kept.append(os.urandom(size))
    return {"pid": os.getpid()}, {}


def text(body: bytearray) -> Answer:
    return {}, {"text": np.array(["no numbers"])}


def babble(body: bytearray) -> Answer:
    return {"long": "x" * 2**21}, {}


def lie(body: bytearray, reply: bytes = b"not JSON ..") -> Answer:
    """Write into the connection, by trying all handles."""
    for handle in range(3, 1000):
        try:
            os.write(handle, len(reply).to_bytes(4, "big") + reply)
        except OSError:
            continue
    return {}, {}


def leave_out(body: bytearray) -> Answer:
    return lie(body, b'{"arrays": []}')


def crash_where_told(body: bytearray, folder: str) -> Answer:
    """Validate a bundle, or crash if there is a file `crash` beside its version."""
    from shapespace.service.repository.validation_task import validate_bundle

    return crash(body) if (Path(folder).parent / "crash").exists() else validate_bundle(body, folder)
