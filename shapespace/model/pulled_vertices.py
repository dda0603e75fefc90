"""Positions of edited vertices as functions of the code, with derivatives."""

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.rigid_motion import align, without_rigid_motion
from shapespace.model.decoder import Decoder, MeshChoice
from shapespace.model.derivatives import carried, derivatives, factor_derivatives
from shapespace.model.searched_shapes import SearchedShapes
from shapespace.solve.deadline import Deadline


class PulledVertices:
    """Normalised positions of k vertices with targets and of all V coarse vertices, as functions of the code.

    The k vertices belong to ``mesh``. If ``rough``, shapes come from face frames and derivatives from the single
    factors, see SearchedShapes.
    """

    def __init__(
        self,
        decoder: Decoder,
        reconstruct: Reconstructor,
        vertices: IntArray,
        mesh: MeshChoice,
        deadline: Deadline | None,
        *,
        rough: bool,
    ) -> None:
        self._decoder, self._reconstruct, self._vertices, self._mesh = decoder, reconstruct, vertices, mesh
        self.shapes, self._rough = SearchedShapes(decoder, reconstruct, deadline, rough=rough), rough
        # The last code with its positions and with its derivatives: several bounds of the objective ask for them.
        self._here = self._moved = (np.full(0, np.nan), np.zeros(0))

    def positions(self, x: FloatArray) -> FloatArray:
        """Return positions (k + V, 3) at a code (m,); not finite where the networks overflow."""
        if not np.array_equal(x, self._here[0]):
            self._here = x.copy(), self.placed(self.shapes(x))
        return self._here[1]

    def derivatives(self, x: FloatArray) -> FloatArray:
        """Return derivatives (m, k + V, 3) of the positions at a code (m,)."""
        if not np.array_equal(x, self._moved[0]):
            slopes = factor_derivatives if self._rough else derivatives
            shape, fields = self.shapes(x), self.shapes.derivatives(x, slopes(self._decoder, x))
            self._moved = x.copy(), carried(self._decoder, self.placed, shape, fields)
        return self._moved[1]

    def sensitivity(self, x: FloatArray, some: IntArray) -> FloatArray:
        """Return derivatives (3k, 2E) of some positions (k,) by lengths and angles at a code (m,).

        The derivative of the fine mesh's offsets along normals is left out.
        """
        decoder, shape = self._decoder, self.shapes(x)
        count, fine = len(shape), decoder.finer(self._mesh)
        weights = fine.prolong.weights if fine else sparse.eye_array(count, format="csr")
        rows = weights[self._vertices[some]][:, :count]
        fields = np.einsum("kv,xy->kxvy", rows.toarray(), np.eye(3)).reshape(-1, count, 3)
        aligned = decoder.placed(shape, self._mesh, carried=shape)
        return self._reconstruct.sensitivity(aligned, without_rigid_motion(fields, aligned))

    def placed(self, shapes: FloatArray) -> FloatArray:
        """Return positions (…, k + V, 3) of shapes (…, V, 3) in any pose, aligned to the reference."""
        fine = self._decoder.finer(self._mesh)
        whole = fine.prolong(shapes) if fine else shapes
        points = np.concatenate([whole[..., self._vertices, :], shapes], axis=-2)
        return align(whole, self._decoder.mesh(self._mesh).vertices, carried=points)
