"""Learned product shape manifolds of triangle meshes: a model turns a few numbers into a 3D shape.

Load a trained model by its name or from its folder, and decode codes:

>>> import numpy as np, shapespace
>>> model = shapespace.load("figure")
>>> positions = model.decode(np.zeros((2, 20)))
>>> positions.shape
(2, 4601, 3)

Find codes of meshes with ``encode``, of edited vertices with ``edit``, and of scans with ``fit_scan``. Pass options by
name or as one object. A deadline ends a search early, and ``status`` says how the search ended:

>>> options = shapespace.EncodeOptions(objective="nric", samples=2)
>>> found = model.encode(positions[0], options, deadline=shapespace.Deadline(seconds=600))
>>> found.status is shapespace.Status.CONVERGED, found.samples.shape
(True, (2, 20))

The Riemannian space of discrete shells, in which models are trained, works with any triangle mesh:

>>> ring = np.arange(8) * np.pi / 4
>>> tube = [[np.cos(t), np.sin(t), z] for z in (0.0, 0.6, 1.2) for t in ring]
>>> quads = [(8 * k + i, 8 * k + (i + 1) % 8) for k in (0, 1) for i in range(8)]
>>> faces = [face for a, b in quads for face in ((a, b, b + 8), (a, b + 8, a + 8))]
>>> mesh = shapespace.TriangleMesh.from_arrays(tube, faces)
>>> space = shapespace.ShellSpace(mesh, shapespace.Material(eta=1e-3))
>>> wider = mesh.vertices * [1.1, 1.0, 1.0]

The logarithm of a shape is a vertex field (V, 3), and the exponential shoots a geodesic with it. Discrete paths have K
steps:

>>> found = shapespace.logarithm(space, mesh.vertices, wider, 4)
>>> path = shapespace.exponential(space, mesh.vertices, found.velocity, 4)
>>> path.converged, path.vertices.shape, bool(np.abs(space.nric(path.vertices[-1]) - space.nric(wider)).max() < 1e-6)
(True, (5, 24, 3), True)

Compute the geodesic between two shapes, and their elastic mean:

>>> shapespace.geodesic(space, mesh.vertices, wider, 4).status
<Status.CONVERGED: 'converged'>
>>> mean = shapespace.elastic_mean(space, [mesh.vertices, wider])
>>> 2.0 < float(np.ptp(mean.vertices[:, 0])) < 2.2
True

The Riemannian centre of mass costs a geodesic to each shape in every iteration, and also returns their logarithms:

>>> centre = shapespace.centre_of_mass(space, [mesh.vertices, wider])
>>> centre.converged, len(centre.logarithms)
(True, 2)

Transport a vector along a path, and differentiate the end of a path by its initial velocity:

>>> carried = shapespace.parallel_transport(space, path, found.velocity)
>>> carried.converged, carried.velocities.shape
(True, (5, 24, 3))
>>> changes = shapespace.ExponentialDerivative(path).push_forward(found.velocity[None])
>>> changes.shape
(1, 24, 3)

An iteration that fails returns a value: look at ``status`` and ``reason`` of the result. ``shapespace.client`` has the
operations of a model over HTTP.
"""

import os
from importlib import import_module
from os.path import isfile
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from shapespace.bundle.finding import models
    from shapespace.bundle.reader import BundleError
    from shapespace.mesh.triangle_mesh import MeshError, TriangleMesh
    from shapespace.model.blend_shapes import PeriodicError
    from shapespace.model.correspondence import InvalidMeshError
    from shapespace.model.decoder import MeshChoice
    from shapespace.model.edit import InvalidTargetError
    from shapespace.model.fit_result import FitStatus
    from shapespace.model.group_comparison import InvalidGroupsError, compare_groups
    from shapespace.model.latent_space import Bounds, Distribution, LatentError
    from shapespace.model.networks import ModelFailedError
    from shapespace.model.options import (
        EditOptions,
        EncodeOptions,
        FitOptions,
        Landmark,
        Objective,
        Prior,
        PriorKind,
        ScaleChoice,
        Target,
    )
    from shapespace.model.scan import InvalidScanError
    from shapespace.model.shape import Quality
    from shapespace.model.shape_model import ShapeModel, load
    from shapespace.shell.energy import Material
    from shapespace.shell.exponential import exponential
    from shapespace.shell.exponential_derivative import ExponentialDerivative
    from shapespace.shell.geodesic import geodesic, logarithm
    from shapespace.shell.mean import centre_of_mass, elastic_mean
    from shapespace.shell.space import ShellSpace
    from shapespace.shell.transport import parallel_transport
    from shapespace.solve.deadline import Deadline
    from shapespace.solve.outcome import Status

# From version 1.29 on, ONNX Runtime reports names and digests of models to its maker, unless this is set before its
# import.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

__version__ = "0.2.0"
__all__ = [
    "Bounds", "BundleError", "Deadline", "Distribution", "EditOptions", "EncodeOptions", "ExponentialDerivative",
    "FitOptions", "FitStatus", "InvalidGroupsError", "InvalidMeshError", "InvalidScanError", "InvalidTargetError",
    "Landmark", "LatentError", "Material", "MeshChoice", "MeshError", "ModelFailedError", "Objective", "PeriodicError",
    "Prior", "PriorKind", "Quality", "ScaleChoice", "ShapeModel", "ShellSpace", "Status", "Target", "TriangleMesh",
    "centre_of_mass", "compare_groups", "elastic_mean", "exponential", "geodesic", "load", "logarithm", "models",
    "parallel_transport",
]  # fmt: skip

#: Public names by the module that defines them.
_NAMES = {
    "bundle.finding": "models",
    "bundle.reader": "BundleError",
    "mesh.triangle_mesh": "MeshError TriangleMesh",
    "model.blend_shapes": "PeriodicError",
    "model.correspondence": "InvalidMeshError",
    "model.decoder": "MeshChoice",
    "model.edit": "InvalidTargetError",
    "model.fit_result": "FitStatus",
    "model.group_comparison": "InvalidGroupsError compare_groups",
    "model.latent_space": "Bounds Distribution LatentError",
    "model.networks": "ModelFailedError",
    "model.options": "EditOptions EncodeOptions FitOptions Landmark Objective Prior PriorKind ScaleChoice Target",
    "model.scan": "InvalidScanError",
    "model.shape": "Quality",
    "model.shape_model": "ShapeModel load",
    "shell.energy": "Material",
    "shell.exponential": "exponential",
    "shell.exponential_derivative": "ExponentialDerivative",
    "shell.geodesic": "geodesic logarithm",
    "shell.mean": "centre_of_mass elastic_mean",
    "shell.space": "ShellSpace",
    "shell.transport": "parallel_transport",
    "solve.deadline": "Deadline",
    "solve.outcome": "Status",
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}


for _name in ("models", "service", "training"):
    if isfile(f"{__path__[0]}/{_name}"):
        raise ImportError(
            f"shapespace/{_name} is a text file where a link to ../{_name} should be, because git made this checkout "
            "without links: on Windows switch on developer mode, then run `git config core.symlinks true` and "
            "`git checkout -- shapespace`."
        )

if not TYPE_CHECKING:  # a type checker would accept any name

    def __getattr__(name: str) -> object:
        # Imported on first use: the client and the workers of a cluster have few of the libraries installed.
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        try:
            module = import_module(f"{__name__}.{_MODULES[name]}")
        except ModuleNotFoundError as error:
            reason = f"shapespace.{name} needs {error.name}: pip install 'shapespace[model]'"
            raise ModuleNotFoundError(reason, name=error.name) from error
        value = getattr(module, name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
