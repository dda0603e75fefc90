"""A search for the place of a feature that moves around a shape, such as a bump, in a scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import nric, wrap
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.triangle_mesh import vertex_normals
from shapespace.model.decoder import Decoder
from shapespace.model.derivatives import batches, nodes
from shapespace.model.pairing import Pairs

#: A move must explain this many times as much of the distances as the present place.
PROMISING = 1.2


@dataclass(frozen=True, eq=False)
class FeatureSearch:
    """Normal displacements of the reference by each periodic factor, at the nodes of the factor's grid.

    Descent alone does not find the place of a feature: where model and scan have it in different places, a small move
    changes nothing. So the distances of the scan are compared with the displacements at all nodes.
    """

    decoder: Decoder
    images: dict[int, FloatArray]  # for each periodic factor, displacements (n, V) at its nodes, normalised

    @classmethod
    def of(cls, decoder: Decoder, reconstruct: Reconstructor) -> FeatureSearch:
        """Compute the displacements, to first order."""
        return cls(
            decoder,
            {
                j: np.concatenate([_normal_displacements(decoder, reconstruct, j, part) for part in parts])
                for j in range(len(decoder.manifest.factors))
                if (parts := batches(nodes(decoder, j)))
            },
        )

    def another(
        self, reconstruct: Reconstructor, code: FloatArray, pairs: Pairs, movable: NDArray[np.bool_]
    ) -> FloatArray | None:
        """Move one factor of a code (m,) to the node that explains the distances of a scan best.

        ``pairs`` belong to the coarse mesh. Factors with a coordinate that is not ``movable`` (m,) stay. Returns None
        if no move promises enough.
        """
        n, best, found = pairs.of_scan, 0.0, None
        # Scan points near a feature in the wrong place find the surface beside it. Only its own vertices are far away.
        known = np.arange(len(pairs.heights)) >= (n if len(pairs.heights) > n else 0)
        for j, images in self.images.items():
            factor = self.decoder.manifest.factors[j]
            own = slice(factor.start, factor.stop)
            if not movable[own].all():
                continue

            def at_points(fields: FloatArray) -> FloatArray:
                return np.einsum("knc,nc->kn", fields[:, pairs.corners], pairs.barycentric)

            here = at_points(_normal_displacements(self.decoder, reconstruct, j, code[None, own]))
            wanted, images = pairs.heights + known * here[0], at_points(images)
            gain = _explained(wanted, images)
            most = float(gain.max() - PROMISING * _explained(wanted, here)[0])
            if most > best:
                best, found = most, code.copy()
                found[own] = nodes(self.decoder, j)[gain.argmax()]
        return found


def _normal_displacements(decoder: Decoder, reconstruct: Reconstructor, j: int, codes: FloatArray) -> FloatArray:
    """Return displacements (n, V) along the reference's normals for codes (n, m_j) of a factor, to first order."""
    reference = decoder.reference
    changes = decoder.factor(j, codes) - nric(reference.vertices, reference.connectivity)
    half = changes.shape[1] // 2
    changes[:, half:] = wrap(changes[:, half:])
    fields = reconstruct.differential(reference.vertices, changes)
    return np.einsum("nvx,vx->nv", fields, vertex_normals(reference.vertices, reference.faces))


def _explained(wanted: FloatArray, images: FloatArray) -> FloatArray:
    """Return how much of ``‖wanted‖²`` (n,) the best multiple of each image (k, n) removes, (k,)."""
    along = np.maximum(images @ wanted, 0)
    return along**2 / np.maximum((images**2).sum(axis=1), np.finfo(float).tiny)
