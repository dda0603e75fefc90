"""A server process for benchmarks, and the memory and processor time of processes (Linux)."""

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import httpx


@contextmanager
def server(
    models: Path, program: Sequence[str] = ("shapespace.service",), **settings: object
) -> Iterator[tuple[httpx.Client, int, float]]:
    """Start a server process; yield a client, the process id, and the seconds until it was ready.

    The program is a module and its arguments. It prints its address.
    """
    began = time.perf_counter()
    more = {f"SHAPESPACE_{name.upper()}": str(value) for name, value in settings.items()}
    process = subprocess.Popen(  # noqa: S603 - our own programs
        [sys.executable, "-m", *program],
        env={**os.environ, "SHAPESPACE_MODELS_DIR": str(models), "SHAPESPACE_PORT": "0", **more},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        address = re.search(r"http://\S+", process.stdout.readline() if process.stdout else "")
        if address is None:
            raise SystemExit("the server did not start")
        with httpx.Client(base_url=address.group(), timeout=120) as client:
            client.get("/v2/health/ready").raise_for_status()
            yield client, process.pid, time.perf_counter() - began
    finally:
        process.terminate()
        process.communicate()


def resident(pid: int) -> float:
    """Return the resident memory of a process in MB."""
    text = Path(f"/proc/{pid}/status").read_text()
    return int(re.findall(r"VmRSS:\s+(\d+)", text)[0]) / 1024


def processor(pid: int) -> float:
    """Return the processor seconds of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
