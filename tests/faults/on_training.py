"""Faults of a training machine: the same command continues the run and ends with the same bits."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from tests.faults.catalogue import FaultTarget, fault
from tests.faults.clock import jumping_clock
from tests.faults.training import LAST
from tests.training.conftest import command, train


def stage_at_work(run: Path) -> str:
    log = run / "log.jsonl"
    begun = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    return next((event["stage"] for event in reversed(begun) if event["event"] == "begin"), "the start")


@fault("training is killed (SIGKILL, with its workers) at random moments")
def kill(target: FaultTarget, rng: np.random.Generator) -> str:
    whole, run = target.undisturbed(), target.folder / "run"
    kills = 0
    for moment in rng.uniform(0, whole.seconds, 2):
        process = subprocess.Popen(
            command(whole.config, run, "--until", LAST),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            process.wait(moment)
        except subprocess.TimeoutExpired:
            kills += 1
        finally:
            with suppress(ProcessLookupError):  # it had already ended
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    train(whole.config, run, "--until", LAST)
    whole.require_the_same(run)
    return f"killed {kills} times, it went on and ended bit for bit as an undisturbed run"


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[list[str]]:
    """A folder that can hold this many bytes; yields the command prefix with which the limit applies.

    It is a file system of that size if mounting is permitted, otherwise a limit on the size of each file,
    which applies to root too.
    """
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(folder)], capture_output=True, check=False
    )
    if mounted.returncode:
        limit = f"import os, resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, ({size // 20}, -1)); "
        yield [sys.executable, "-c", limit + "os.execvp(sys.argv[1], sys.argv[1:])"]
        return
    try:
        yield []
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@fault("the disk is full while training")
def full_disk(target: FaultTarget, rng: np.random.Generator) -> str:
    whole, disk = target.undisturbed(), target.folder / "disk"
    size = int(rng.uniform(0.02, 0.25) * whole.bytes)  # the samples alone take more
    with small_disk(disk, size) as prefix:
        arguments = [*prefix, *command(whole.config, disk / "run", "--until", "samples")]
        full = subprocess.run(arguments, capture_output=True, text=True, check=False)
        stage = stage_at_work(disk / "run")
        assert full.returncode == 1, full.stderr
        assert "No space left on device" in full.stderr or "File too large" in full.stderr, full.stderr
        if not prefix:
            subprocess.run(["mount", "-o", f"remount,size={10 * whole.bytes}", str(disk)], check=True)
        train(whole.config, disk / "run", "--until", "samples")
        whole.require_the_same(disk / "run", "samples")
    return f"stopped in {stage}, status 1 and the reason; with room again it went on to the same bits"


@contextmanager
def read_only(folder: Path) -> Iterator[str]:
    """Make a folder read-only, for root too: by a mount, by its mode, or by a file in its place."""
    bind = ["mount", "--bind", str(folder), str(folder)]
    if subprocess.run(bind, capture_output=True, check=False).returncode == 0:
        subprocess.run(["mount", "-o", "remount,bind,ro", str(folder)], check=True)
        try:
            yield "Read-only file system"
        finally:
            subprocess.run(["umount", "--lazy", str(folder)], check=True)
    elif os.geteuid():
        mode = folder.stat().st_mode
        folder.chmod(0o555)
        try:
            yield "Permission denied"
        finally:
            folder.chmod(mode)
    else:
        away = folder.rename(folder.with_name("away"))
        folder.touch()
        try:
            yield "Not a directory"
        finally:
            folder.unlink()
            away.rename(folder)


@fault("the run directory is read-only")
def read_only_run(target: FaultTarget, rng: np.random.Generator) -> str:
    whole, run = target.undisturbed(), target.folder / "run"
    before = str(rng.choice(["ingest", "mean", "modes", "factors"]))
    train(whole.config, run, "--until", before)
    until_samples = command(whole.config, run, "--until", "samples")
    with read_only(run) as reason:
        refused = subprocess.run(until_samples, capture_output=True, text=True, check=False)
        assert refused.returncode == 1
        assert reason in refused.stderr or "File exists" in refused.stderr, refused.stderr
    train(whole.config, run, "--until", "samples")
    whole.require_the_same(run, "samples")
    return f"status 1 and the reason after {before}; writable again it went on to the same bits"


@fault("the clock jumps while training")
def clock_while_training(target: FaultTarget, rng: np.random.Generator) -> str:
    whole, run = target.undisturbed(), target.folder / "run"
    with jumping_clock(target.folder) as clock:
        process = subprocess.Popen(
            command(whole.config, run, "--until", "samples"),
            env=clock.environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        while process.poll() is None:
            clock.jump(rng.uniform(-10, 10))
            time.sleep(0.1)
        _, errors = process.communicate()
    assert process.returncode == 0, errors
    whole.require_the_same(run, "samples")
    return "back and forth by years; the same bits"
