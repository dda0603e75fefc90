"""Validation of a bundle before it is served, as a task of a sandbox."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shapespace.bundle.reader import BundleError, read_bundle
from shapespace.files.limits import in_words
from shapespace.model.decoder import Decoder
from shapespace.service.limits.sandbox_child import raise_memory_limit
from shapespace.service.limits.sandbox_messages import Arrays, JsonObject
from shapespace.service.refusals import RefusedError
from shapespace.solve.cholesky import SymmetricPattern, analyse

#: Bytes that the solver may take for each vertex of the coarse mesh, about twice its need.
MEMORY_PER_VERTEX = 64 * 2**10
#: Most bytes that the solver may take.
SOLVER_MEMORY = 4 * 2**30
# Loads the library of factorisations now, because its time and memory must not count for the first bundle.
analyse(SymmetricPattern(1, np.array([0]), np.array([0])))


def validate_bundle(body: bytearray, folder: str) -> tuple[JsonObject, Arrays]:
    """Load a bundle, and compute with it once as the server does; returns its ``digest``, or raises RefusedError."""
    try:
        bundle = read_bundle(Path(folder))
        raise_memory_limit(min(MEMORY_PER_VERTEX * bundle.manifest.vertices, SOLVER_MEMORY))
        Decoder(bundle).self_test()
    except BundleError as error:
        raise RefusedError("refused", str(error)) from None
    except OSError as error:
        raise RefusedError("refused", in_words(error)) from None
    return {"digest": bundle.digest}, {}
