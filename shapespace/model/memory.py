"""Memory of training shapes: a correction in the combiner, which can be left out, or fade along a path of codes.

An export adds Gaussians around the codes of training shapes to the combiner, so that the model reproduces these shapes.
Between training shapes the Gaussians would speed a path up and slow it down. On a segment between two keyframes, the
corrections of the two keyframes therefore fade in proportion to the position, and no other training shape counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import onnx
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.model.latent_space import Codes

#: Optional input of a switched combiner: factor of the correction, for all rows or for each (n, 1).
FACTOR = "memory.factor"
#: Arrays of the memory, as the export names them: codes of examples, and weights of their Gaussians.
_PLACES, _WEIGHTS = "places", "weights"


@dataclass(frozen=True)
class Fade:
    """Segments on which frames (n,) lie: their ends (n, m), and the position of each frame, 0 at the first end."""

    first: NDArray[np.floating]
    last: NDArray[np.floating]
    share: FloatArray

    def __getitem__(self, some: slice) -> Fade:
        return Fade(self.first[some], self.last[some], self.share[some])

    def followed_by(self, code: Codes) -> Fade:
        """Append a keyframe (m,)."""
        first, last = (np.concatenate([each, code[None]]) for each in (self.first, self.last))
        return Fade(first, last, np.append(self.share, 0.0))

    def __bytes__(self) -> bytes:
        return b"".join(np.ascontiguousarray(part).tobytes() for part in (self.first, self.last, self.share))


#: Whether shapes have the memory: as at single codes, not at all, or as on segments of a path.
Examples = bool | Fade


def switched(content: bytes) -> bytes | None:
    """Return a combiner's file with the optional input FACTOR, which is 1 by default; None if it has no memory."""
    model = onnx.load_model_from_string(content)
    graph = model.graph
    names = {tensor.name.removesuffix(".narrow") for tensor in graph.initializer}
    products = [node for node in graph.node if node.op_type == "MatMul" and [*node.input[1:]] == [_WEIGHTS]]
    if len(products) != 1 or not {_PLACES, _WEIGHTS} <= names:
        return None
    product = products[0]
    own = product.output[0]
    product.output[0] = f"{own}.whole"
    graph.node.insert(
        [*graph.node].index(product) + 1, onnx.helper.make_node("Mul", [product.output[0], FACTOR], [own])
    )
    graph.initializer.append(onnx.numpy_helper.from_array(np.ones((1, 1), np.float32), FACTOR))
    graph.input.append(onnx.helper.make_tensor_value_info(FACTOR, onnx.TensorProto.FLOAT, [None, 1]))
    return bytes(model.SerializeToString())


def rows_of_segment(code: Codes, fade: Fade) -> tuple[Codes, NDArray[np.float32]]:
    """Return codes (5, m) and factors (5, 1) of the networks' runs for one frame on a segment, see `faded`."""
    first, last = fade.first[0], fade.last[0]
    return np.stack([code, first, first, last, last]), np.array([0, 0, 1, 0, 1], np.float32)[:, None]


def faded(z: FloatArray, share: float) -> FloatArray:
    """Return the NRIC (2E,) of a frame, from NRIC (5, 2E) of the codes and factors of `rows_of_segment`."""
    found: FloatArray = z[0] + (1 - share) * (z[2] - z[1]) + share * (z[4] - z[3])
    return found
