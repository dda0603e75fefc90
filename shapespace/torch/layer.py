"""`ShapeLayer`, and the module from codes to vertices that it wraps."""

from __future__ import annotations

import os
from collections.abc import Callable

import torch
from torch import Tensor, nn

from shapespace.bundle.finding import find_bundle
from shapespace.bundle.reader import Bundle, read_bundle
from shapespace.coordinates.frame_integration import FrameIntegration
from shapespace.torch.arrays import ArrayModule
from shapespace.torch.frames import FrameVertices
from shapespace.torch.networks import TorchNetwork
from shapespace.torch.surfaces import FineVertices, Misfit, RigidAlignment


class VerticesFromNRIC(ArrayModule):
    """Lengths and angles (n, 2E) → vertices (n, V, 3) of drafts, and their misfits (n,).

    The fine mesh, aligned to the reference, in the user's units.
    """

    vertex_slots: Tensor

    def __init__(self, bundle: Bundle, dtype: torch.dtype) -> None:
        super().__init__(dtype)
        reference = bundle.reference
        self.frames = FrameVertices(FrameIntegration(reference).plan, reference, dtype)
        slots = self.frames.slots
        self.misfit = Misfit(reference, bundle.manifest.eta_reconstruction, slots, dtype)
        finest = bundle.fine.reference if bundle.fine else reference
        self.alignment = RigidAlignment(finest.vertices, dtype)
        self.fine = None
        if bundle.fine:
            self.fine = FineVertices(bundle.fine.prolong, slots, self.frames.slot_count, dtype)
        else:
            self.keep("vertex_slots", slots)
        self._scale = bundle.manifest.scale

    def forward(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return vertices and misfits."""
        coarse = self.frames(z)
        fine = self.fine(coarse) if self.fine is not None else coarse.index_select(1, self.vertex_slots)
        return self._scale * self.alignment(fine), self.misfit(coarse, z)


class DecodedShapes(nn.Module):
    """Codes (n, m) → vertices (n, V, 3) of drafts, and their misfits (n,).

    Raises BundleError if a network has operators that are not known.
    """

    def __init__(self, bundle: Bundle, dtype: torch.dtype) -> None:
        super().__init__()
        manifest = bundle.manifest
        self._ranges = [(factor.start, factor.stop) for factor in manifest.factors]
        self.factors = nn.ModuleList(
            TorchNetwork(bundle.networks[factor.file], factor, dtype) for factor in manifest.factors
        )
        self.combiner = TorchNetwork(bundle.networks[manifest.combiner.file], manifest.combiner, dtype)
        self.vertices = VerticesFromNRIC(bundle, dtype)

    def forward(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Return vertices and misfits."""
        shapes = [network(latent[:, a:b]) for network, (a, b) in zip(self.factors, self._ranges, strict=True)]
        found: tuple[Tensor, Tensor] = self.vertices(self.combiner(torch.stack(shapes, dim=1)))
        return found


class ShapeLayer(nn.Module):
    """A trained model as a layer: codes (n, m) → positions (n, V, 3), with derivatives.

    Positions are on the fine mesh, aligned to the reference, in the units of the training meshes. They are the
    server's drafts (``quality="draft"``). The layer has no parameters: codes are the variables.

    Args:
        folder: folder NAME/VERSION of a bundle, or a name, as for `shapespace.load`.
        dtype: type of codes and positions, ``torch.float32`` or ``torch.float64``. ``.double()`` and ``.float()``
            change it later, and read the bundle again, so that nothing is rounded twice.

    Attributes:
        faces: (F, 3) corners of the faces, from 0.
        lower, upper: (m,) bounds of the codes.
        names: name of each coordinate.

    Raises:
        BundleError: the bundle differs from its manifest, or a network has operators that the layer doesn't know.

    >>> import torch
    >>> from shapespace.torch import ShapeLayer
    >>> layer = ShapeLayer("models/figure/4")
    >>> codes = torch.zeros(2, 20, requires_grad=True)
    >>> positions = layer(codes)
    >>> positions.shape, layer.faces.shape
    (torch.Size([2, 4601, 3]), torch.Size([9198, 3]))
    >>> positions[:, :, 1].amax(dim=1).sum().backward()
    >>> codes.grad.shape
    torch.Size([2, 20])
    """

    faces: Tensor
    lower: Tensor
    upper: Tensor

    def __init__(self, folder: str | os.PathLike[str], dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        self._folder = find_bundle(folder)
        bundle = self._read(dtype)
        finest = bundle.fine.reference if bundle.fine else bundle.reference
        self.names = list(bundle.manifest.latent_names)
        self.register_buffer("faces", torch.tensor(finest.faces))
        self.register_buffer("lower", torch.tensor(bundle.manifest.lower, dtype=dtype))
        self.register_buffer("upper", torch.tensor(bundle.manifest.upper, dtype=dtype))

    def _read(self, dtype: torch.dtype) -> Bundle:
        if dtype not in (torch.float32, torch.float64):
            raise TypeError(f"a shape layer computes in torch.float32 or torch.float64, not in {dtype}")
        bundle = read_bundle(self._folder)
        self.decoded = DecodedShapes(bundle, dtype)
        return bundle

    def _apply(self, function: Callable[[Tensor], Tensor], recurse: bool = True) -> ShapeLayer:
        wanted = function(self.lower).dtype
        if wanted != self.lower.dtype:
            bundle = self._read(wanted)
            for name in ("lower", "upper"):
                self._buffers[name] = torch.tensor(getattr(bundle.manifest, name), dtype=wanted)
        super()._apply(function, recurse)
        return self

    def forward(self, codes: Tensor) -> Tensor:
        """Return positions (n, V, 3) of codes (n, m)."""
        if not isinstance(codes, Tensor):
            raise TypeError(f"codes are {type(codes).__name__}, not a tensor: convert them by torch.as_tensor(codes)")
        if codes.ndim != 2 or codes.shape[1] != len(self.names):
            raise ValueError(f"codes must be (n, {len(self.names)}), not {tuple(codes.shape)}")
        if codes.dtype != self.lower.dtype:
            raise TypeError(
                f"codes are {codes.dtype}, but the layer computes in {self.lower.dtype}: convert the codes by "
                "codes.to(layer.lower.dtype), or the layer by layer.double() or layer.float()"
            )
        positions: Tensor = self.decoded(codes)[0]
        return positions
