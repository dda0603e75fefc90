"""Fit a model to an uploaded scan."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from shapespace.files.limits import Limits
from shapespace.model.fit_result import Distances, FitStatus
from shapespace.model.options import FitOptions
from shapespace.model.shape_model import ShapeModel
from shapespace.service.limits.sandbox import Sandbox
from shapespace.service.limits.workers import Caller, Workers
from shapespace.service.use_cases.codes import Found, Upload, placement, read_upload
from shapespace.service.use_cases.shape_formats import dump_json, float32
from shapespace.solve.deadline import Deadline

#: Maximum numbers of vertices and faces of a scan; memory in bytes that reading may take in addition to the file.
LIMITS, MEMORY = Limits(2**21, 2**21), 256 * 2**20


async def fit(
    workers: Workers,
    sandbox: Sandbox,
    caller: Caller,
    model: ShapeModel,
    upload: Upload,
    options: Callable[[str], FitOptions],
) -> Found:
    """Find the code, placement and size that explain a scan; see ShapeModel.fit_scan.

    Args:
        workers: workers that compute.
        sandbox: sandbox that reads the file.
        caller: caller who waits.
        model: model to fit.
        upload: scan file.
        options: returns the options, given the form's field ``options``, which may be empty.

    Raises:
        UploadError, InvalidScanError: the scan can't be used.
        BusyError, DeadlineError, DisconnectedError, EndingError: the server is busy, or the call ended early.
    """

    def make(deadline: Deadline) -> Found:
        began = time.perf_counter()
        points, faces, said = read_upload(sandbox, upload, LIMITS, deadline, points=True, memory=MEMORY)
        asked = options(said)
        read = time.perf_counter()
        found = model.fit_scan((points, faces), asked, deadline=deadline)
        if found.status is FitStatus.DEADLINE:
            raise workers.late()
        content = {
            "latent": found.code,
            "covariance": found.covariance,
            "placement": placement(found.placement),
            "distances": {"scan": _distances(found.scan), "model": _distances(found.model)},
            "explained": found.explained,
            "seen": found.seen,
            "noise": found.noise,
            "mirrored": found.mirrored,
            "status": found.status,
            "reason": found.reason,
            "sampled": found.sampled,
            "shapes": {"solved": found.solved, "rough": found.rough},
            "diagnostics": asdict(found.shape.diagnostics),
        }
        if found.used is not None:
            content["used"] = {"positions": float32(found.used[:, :3]), "distances": float32(found.used[:, 3])}
        if asked.samples:
            content["samples"] = found.samples
        return Found(dump_json(content), {"read": read - began, "search": time.perf_counter() - read})

    async with workers.admit(caller) as call:
        return await workers.run(make, call)


def _distances(found: Distances) -> dict[str, Any]:
    figures: dict[str, Any] = {"mean": found.mean, "p95": found.p95, "max": found.max}
    return figures if found.points is None else figures | {"points": float32(found.points)}
