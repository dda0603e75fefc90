"""Validating a bundle before it is served; runs in a sandbox's child."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shapespace.bundle.reader import BundleError, read_bundle
from shapespace.model.decoder import Decoder
from shapespace.service.limits.sandbox_child import allow
from shapespace.service.limits.sandbox_errors import FailedError
from shapespace.service.limits.sandbox_wire import Arrays, Facts
from shapespace.solve.cholesky import SymmetricPattern, analyse

#: Memory, in bytes, that the solver may take for each vertex of the coarse mesh (about twice what it needs), and in
#: all.
OF_A_VERTEX, MOST_OF_VERTICES = 64 * 2**10, 4 * 2**30
# Loads the library for factorisations now: its time and memory must not count against the first bundle.
analyse(SymmetricPattern(1, np.array([0]), np.array([0])))


def validate_bundle(body: bytearray, folder: str) -> tuple[Facts, Arrays]:
    """Load a bundle, and do once what serving does with it.

    Args:
        body: empty.
        folder: of the bundle.

    Returns:
        Its ``digest``.

    Raises:
        FailedError: it must not be served, and why.
    """
    try:
        bundle = read_bundle(Path(folder))
        allow(min(OF_A_VERTEX * bundle.manifest.vertices, MOST_OF_VERTICES))
        Decoder(bundle).self_test()
    except (BundleError, OSError) as error:
        raise FailedError("refused", str(error)) from None
    return {"digest": bundle.digest}, {}
