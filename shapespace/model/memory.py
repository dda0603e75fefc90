"""Memory of training shapes: a correction in the combiner, which can be left out, or fade along a path of codes.

An export adds Gaussians around the codes of training shapes to the combiner, so that the model reproduces these shapes.
Between training shapes the Gaussians would speed a path up and slow it down. On a segment between two keyframes, the
corrections of the two keyframes therefore fade in proportion to the position, and no other training shape counts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import onnx
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.model.latent_space import Codes

#: Optional input of a switched combiner: factor of the correction, for all rows or for each (n, 1).
FACTOR = "memory.factor"
#: Arrays of the memory, as the export names them: codes of examples, and weights of their Gaussians.
_PLACES, _WEIGHTS = "places", "weights"
#: Number of frames for which the networks of a draft or of ``auto`` run at once.
FRAMES_PER_RUN = 4


@dataclass(frozen=True)
class Fade:
    """Segments on which frames (n,) lie.

    Attributes:
        first, last: ends (n, m) of the segments.
        share: position (n,) of each frame, 0 at the first end.
        row: row (n,) of each frame in a run of the networks, below FRAMES_PER_RUN. The row changes the last digits, so
            it depends on the frame's number alone.
    """

    first: NDArray[np.floating]
    last: NDArray[np.floating]
    share: FloatArray
    row: IntArray

    def __getitem__(self, some: slice) -> Fade:
        return Fade(self.first[some], self.last[some], self.share[some], self.row[some])

    def followed_by(self, code: Codes) -> Fade:
        """Append a keyframe (m,)."""
        first, last = (np.concatenate([each, code[None]]) for each in (self.first, self.last))
        return Fade(first, last, np.append(self.share, 0.0), np.append(self.row, 0))

    def runs(self) -> Iterator[slice]:
        """Yield ranges of frames on one segment whose rows increase, so that one run of the networks has them all."""
        turned = (self.first[1:] != self.first[:-1]).any(axis=1) | (self.last[1:] != self.last[:-1]).any(axis=1)
        begins = 1 + np.flatnonzero(turned | (np.diff(self.row) <= 0))
        stops = [0, *begins.tolist(), len(self.row)]
        return (slice(*ends) for ends in pairwise(stops))

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


def on_segment(networks: Callable[..., FloatArray], codes: Codes, fade: Fade, several: bool) -> FloatArray:
    """Return the NRIC (n, 2E) of frames (n, m) on one segment. A keyframe has the bytes of its code alone.

    Args:
        networks: NRIC (k, 2E) of codes (k, m), without or with the memory by factors (k, 1), 0 or 1.
        codes: codes of the frames of one of `Fade.runs`, or of one frame.
        fade: the same frames.
        several: whether runs have FRAMES_PER_RUN rows for frames, and each frame its row. Otherwise there is one row.
    """
    keyframes = np.isin(fade.share, (0, 1))
    alone = {k: networks(codes[k : k + 1])[0] for k in np.flatnonzero(keyframes)}
    if keyframes.all():
        return np.stack([*alone.values()])
    row = fade.row if several else np.zeros(len(codes), dtype=np.int64)
    rows = np.repeat(codes[:1], FRAMES_PER_RUN if several else 1, axis=0)
    rows[row] = codes
    ends = np.stack([fade.first[0], fade.first[0], fade.last[0], fade.last[0]])
    factors = np.array([0] * len(rows) + [0, 1, 0, 1], np.float32)[:, None]
    z = networks(np.concatenate([rows, ends]), factors)
    first, with_first, last, with_last = z[-4:]
    share = fade.share[:, None]
    found: FloatArray = z[row] + (1 - share) * (with_first - first) + share * (with_last - last)
    for k, own in alone.items():
        found[k] = own
    return found
