"""Bundles that don't agree with their manifests are refused with one line each; others are not affected."""

import json
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from tests.faults.catalogue import FaultTarget, fault
from tests.faults.serving import Steady
from tests.service.watching import eventually

#: Number of bundles damaged at the same time.
BATCH = 8
Facts = dict[str, Any]


def require_refusals(steady: Steady, spoil: Callable[[Path, int], None]) -> None:
    """Add damaged bundles to those of a running server and reload: it refuses each with one line."""
    sound = steady.models / "small" / "1"
    folders = [steady.models / f"spoilt-{k}" / "1" for k in range(BATCH)]
    try:
        for k, folder in enumerate(folders):
            shutil.copytree(sound, folder)
            manifest = folder / "manifest.json"
            manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"name": folder.parent.name}))
            spoil(folder, k)
        lines = reload(steady)
        refused = [line for line in lines if "is not served: " in line]
        assert len(refused) == BATCH, lines
        for k in range(BATCH):
            assert sum(f"spoilt-{k}/1 " in line for line in refused) == 1, lines
        listed = [model["name"] for model in steady.client.get("/v1/models").json()["models"]]
        assert listed == ["small", "with-fine"]
    finally:
        for folder in folders:
            shutil.rmtree(folder.parent, ignore_errors=True)
        reload(steady)
    steady.check()


def reload(steady: Steady) -> list[str]:
    """Let the server reload its folder, and return what it logged."""
    before = len(steady.server.log)
    steady.server.process.send_signal(signal.SIGHUP)
    eventually(lambda: "reloaded: " in steady.server.log[before:])
    return steady.server.log[before:].splitlines()


def victims(folder: Path) -> list[Path]:
    """Files whose digests are in the manifest."""
    return sorted(path for path in folder.iterdir() if path.name != "manifest.json")


def cut(folder: Path, rng: np.random.Generator) -> None:
    path = folder / str(rng.choice([path.name for path in folder.iterdir()]))
    os.truncate(path, int(rng.integers(path.stat().st_size)))


def flip(folder: Path, rng: np.random.Generator) -> None:
    path = folder / str(rng.choice([path.name for path in victims(folder)]))
    data = bytearray(path.read_bytes())
    data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    path.write_bytes(data)


def nudge(facts: Facts, rng: np.random.Generator) -> None:
    field = rng.choice(["edges", "vertices", "faces", "latent_dimension"])
    facts[str(field)] += int(rng.choice([-1, 1, 10**6, 2**62]))


def wrong_digest(facts: Facts, rng: np.random.Generator) -> None:
    entry = facts["files"][str(rng.choice(sorted(facts["files"])))]
    digits = list(entry["sha256"])
    place = int(rng.integers(64))
    digits[place] = "0" if digits[place] != "0" else "f"
    entry["sha256"] = "".join(digits)


def wrong_size(facts: Facts, rng: np.random.Generator) -> None:
    facts["files"][str(rng.choice(sorted(facts["files"])))]["bytes"] += int(rng.choice([-1, 1, -(10**12), 10**12]))


def shorter_list(facts: Facts, rng: np.random.Generator) -> None:
    facts[str(rng.choice(["latent_names", "lower", "upper", "period", "factors"]))].pop()


def wrong_slice(facts: Facts, rng: np.random.Generator) -> None:
    facts["factors"][int(rng.integers(2))][str(rng.choice(["start", "stop"]))] += int(rng.choice([1, 2, 10**9]))


def wrong_wire(facts: Facts, rng: np.random.Generator) -> None:
    network = [facts["combiner"], *facts["factors"]][int(rng.integers(3))]
    network[str(rng.choice(["input", "output", "file"]))] = str(rng.choice(["nothing", "geometry.npz", "z"]))


def wrong_kind(facts: Facts, rng: np.random.Generator) -> None:
    field = str(rng.choice(["lower", "scale", "files", "factors", "geometry", "mu", "schema_version"]))
    facts[field] = [None, "text", -1, [], {}, [[]]][int(rng.integers(6))]


LIES = (nudge, wrong_digest, wrong_size, shorter_list, wrong_slice, wrong_wire, wrong_kind)


def lie(folder: Path, rng: np.random.Generator) -> None:
    path = folder / "manifest.json"
    facts = json.loads(path.read_text())
    LIES[int(rng.integers(len(LIES)))](facts, rng)
    path.write_text(json.dumps(facts))


@fault("files of a bundle are cut short, bits are flipped, or the manifest lies")
def damage(target: FaultTarget, rng: np.random.Generator) -> str:
    ways = (cut, flip, lie, lie)
    require_refusals(target.steady, lambda folder, k: ways[k % len(ways)](folder, rng))
    return f"all {BATCH} at a time refused, a line each; the others served as before"


#: Names that lead out of a folder, or somewhere else on some system.
WAYS_OUT = (
    "../{}", "../../with-fine/1/{}", "/etc/passwd", "./{}", "x/../{}", "..", ".", "", "\\..\\{}", "C:{}", "{}\0",
    "~/{}", "%2e%2e/{}", "{}/", "\u2025/{}", "{}\n", ".{}",
)  # fmt: skip


def link_outside(folder: Path, file: str) -> None:
    outside = folder.parents[1] / f".outside-{folder.parent.name}"
    (folder / file).replace(outside)
    (folder / file).symlink_to(outside)


def endless(folder: Path, file: str) -> None:
    (folder / file).unlink()
    (folder / file).symlink_to("/dev/zero")


def pipe(folder: Path, file: str) -> None:
    (folder / file).unlink()
    os.mkfifo(folder / file)


def ring(folder: Path, file: str) -> None:
    (folder / file).unlink()
    (folder / file).symlink_to(file)


@fault("links, pipes and `..` in the names of a bundle")
def ways_out(target: FaultTarget, rng: np.random.Generator) -> str:
    steady = target.steady

    def spoil(folder: Path, k: int) -> None:
        file = str(rng.choice([path.name for path in victims(folder)]))
        if k % 2:
            (link_outside, endless, pipe, ring)[k // 2 % 4](folder, file)
            return
        path = folder / "manifest.json"
        facts = json.loads(path.read_text())
        name = WAYS_OUT[rng.integers(len(WAYS_OUT))].format(file)
        facts["files"][name] = facts["files"].pop(file)
        for network in (facts["combiner"], facts["geometry"], *facts["factors"]):
            network["file"] = name if network["file"] == file else network["file"]
        path.write_text(json.dumps(facts))

    try:
        require_refusals(steady, spoil)
    finally:
        for outside in steady.models.glob(".outside-*"):
            outside.unlink()
    # The same by HTTP: paths with `..`, in every spelling that a client may send.
    secret = steady.models / "small" / "1" / "manifest.json"
    for climb in ("../" * 8, "%2e%2e/" * 8, "..%2f" * 8, "..\\" * 8, "%252e%252e/" * 8, "//", "....//" * 8):
        for base in ("/page/", "/v1/models/", "/v1/interpolations/", "/v2/models/", "/"):
            path = f"{base}{climb}{str(secret).lstrip('/')}".encode()
            answer = steady.client.send(
                httpx.Request("GET", httpx.URL(steady.url).copy_with(raw_path=path))  # unnormalised
            )
            assert answer.status_code in {404, 405}, (path, answer.status_code)
            assert b"sha256" not in answer.content
    return f"all {BATCH} at a time refused; 35 paths that climb out of a folder: 404"


@fault("bundles appear, change, break and vanish while requests run")
def swapped(target: FaultTarget, rng: np.random.Generator) -> str:
    from tests.faults.swapping import swap

    return swap(target, rng)
