"""The affine sum of the factors, without a correction."""

from __future__ import annotations

import torch
from torch import Tensor

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.combiners.correction import Correction, JointSamples
from shapespace.training.runs.network_settings import SumSettings


class SumCorrection(Correction):
    """No correction: the joint shape is the affine sum. It is exact for a single factor."""

    @classmethod
    def fit(
        cls, settings: SumSettings, reference: TriangleMesh, own: JointSamples, held_out: JointSamples, seed: int
    ) -> SumCorrection:
        return cls({})

    def difference(self, y: Tensor) -> Tensor:
        return torch.zeros_like(y[:, 0])
