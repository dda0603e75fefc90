"""Learned product shape manifolds of triangle meshes: a handful of numbers in, a shape out.

A trained model, from its folder:

>>> import numpy as np, shapespace
>>> model = shapespace.load("models/figure")
>>> positions = model.decode(np.zeros((2, 20)))
>>> positions.shape
(2, 4601, 3)

The Riemannian space of discrete shells that models are trained on, for any triangle mesh:

>>> ring = np.arange(8) * np.pi / 4
>>> tube = [[np.cos(t), np.sin(t), z] for z in (0.0, 0.6, 1.2) for t in ring]
>>> quads = [(8 * k + i, 8 * k + (i + 1) % 8) for k in (0, 1) for i in range(8)]
>>> faces = [face for a, b in quads for face in ((a, b, b + 8), (a, b + 8, a + 8))]
>>> mesh = shapespace.TriangleMesh.from_arrays(tube, faces)
>>> space = shapespace.ShellSpace(mesh, shapespace.Material(eta=1e-3))
>>> wider = mesh.vertices * [1.1, 1.0, 1.0]

What joins two shapes, a vertex field (V, 3), and a geodesic shot with it; discrete paths have K steps:

>>> found = shapespace.logarithm(space, mesh.vertices, wider, 4)
>>> path = shapespace.exponential(space, mesh.vertices, found.velocity, 4)
>>> path.converged, path.vertices.shape, bool(np.abs(space.nric(path.vertices[-1]) - space.nric(wider)).max() < 1e-6)
(True, (5, 24, 3), True)

The geodesic between them, and their elastic mean:

>>> shapespace.geodesic(space, mesh.vertices, wider, 4).status
<Status.CONVERGED: 'converged'>
>>> mean = shapespace.elastic_mean(space, [mesh.vertices, wider])
>>> 2.0 < float(np.ptp(mean.vertices[:, 0])) < 2.2
True

The Riemannian centre of mass, which costs a geodesic to each shape in every iteration, and those geodesics' logarithms:

>>> centre = shapespace.centre_of_mass(space, [mesh.vertices, wider])
>>> centre.converged, len(centre.logarithms)
(True, 2)

A vector carried along a path, and how the last shape of a path changes with the velocity that it was shot with:

>>> carried = shapespace.parallel_transport(space, path, found.velocity)
>>> carried.converged, carried.velocities.shape
(True, (5, 24, 3))
>>> changes = shapespace.ExponentialDerivative(path).push_forward(found.velocity[None])
>>> changes.shape
(1, 24, 3)

An iteration that fails is a value: look at ``status`` and ``reason`` of what comes back. ``shapespace.client`` has the
calls of a model over HTTP.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from shapespace.mesh.triangle_mesh import TriangleMesh
    from shapespace.model.shape_model import ShapeModel, load
    from shapespace.shell.energy import Material
    from shapespace.shell.exponential import exponential
    from shapespace.shell.exponential_derivative import ExponentialDerivative
    from shapespace.shell.geodesic import geodesic, logarithm
    from shapespace.shell.mean import centre_of_mass, elastic_mean
    from shapespace.shell.space import ShellSpace
    from shapespace.shell.transport import parallel_transport

__version__ = "0.2.0"
__all__ = [
    "ExponentialDerivative",
    "Material",
    "ShapeModel",
    "ShellSpace",
    "TriangleMesh",
    "centre_of_mass",
    "elastic_mean",
    "exponential",
    "geodesic",
    "load",
    "logarithm",
    "parallel_transport",
]

_MODULES = {
    "ExponentialDerivative": "shell.exponential_derivative",
    "Material": "shell.energy",
    "ShapeModel": "model.shape_model",
    "ShellSpace": "shell.space",
    "TriangleMesh": "mesh.triangle_mesh",
    "centre_of_mass": "shell.mean",
    "elastic_mean": "shell.mean",
    "exponential": "shell.exponential",
    "geodesic": "shell.geodesic",
    "load": "model.shape_model",
    "logarithm": "shell.geodesic",
    "parallel_transport": "shell.transport",
}


if not TYPE_CHECKING:  # a type checker would take any name for one of these

    def __getattr__(name: str) -> object:
        # Imported when first asked for: the client and the workers of a cluster have few of the libraries installed.
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
