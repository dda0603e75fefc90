"""A fully connected combiner: a perceptron on the lengths and angles of all factors."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor, nn

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.combiners.correction import Correction, JointSamples
from shapespace.training.learning.layers import perceptron
from shapespace.training.runs.network_settings import DenseSettings, FitSettings


class DenseCorrection(Correction):
    """Perceptron from the scaled differences of all J factors, (n, 2EJ), to the scaled differences of the joint shape.

    With ``residual`` it corrects the affine sum, and starts at zero. Otherwise it puts out the joint shape itself.
    """

    def __init__(self, settings: DenseSettings, factor_count: int, entries: int) -> None:
        super().__init__({})
        self.settings = settings
        sizes = [factor_count * entries, *settings.hidden, entries]
        self.perceptron = perceptron(sizes, settings.normalisation, settings.dropout)
        if settings.residual:
            for parameter in self.perceptron[-1].parameters():
                nn.init.zeros_(parameter)

    @classmethod
    def fit(
        cls, settings: DenseSettings, reference: TriangleMesh, own: JointSamples, held_out: JointSamples, seed: int
    ) -> DenseCorrection:
        result = cls(settings, *own.factors.shape[1:])
        result.penalise_gaps(settings.integrability, reference, own.scaling)
        return result

    @classmethod
    def load(cls, settings: DenseSettings, reference: TriangleMesh, tensors: Mapping[str, Tensor]) -> DenseCorrection:
        entries = 2 * reference.connectivity.edge_count
        result = cls(settings, tensors["perceptron.0.weight"].shape[1] // entries, entries)
        result.load_state_dict(tensors)
        return result

    @property
    def descent(self) -> FitSettings:
        return self.settings.fit

    def forward(self, y: Tensor) -> Tensor:
        found: Tensor = self.perceptron(y.flatten(1))
        return found + y.sum(dim=1) if self.settings.residual else found
