"""The mean of a collection, where its tangent space is attached."""

from dataclasses import replace

from shapespace.arrays import FloatArray
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.energy import Material
from shapespace.shell.exponential import exponential
from shapespace.shell.mean import Mean, elastic_mean
from shapespace.shell.space import FirstStep, ShellSpace
from shapespace.solve.outcome import Status
from shapespace.training.runs.progress import waiting
from shapespace.training.space.logarithms import logarithms
from shapespace.training.space.modes import ModeError


def centred_mean(
    reference: TriangleMesh,
    shapes: FloatArray,
    material: Material,
    steps: int,
    workers: int = -1,
    first_step: FirstStep = "centred",
    reached: float = 0,
) -> Mean:
    """Compute the elastic mean, moved by the mean of the logarithms there.

    This is one step of Karcher's iteration towards the Riemannian centre of mass (paper, section 3). Without it, one
    mode would be spent on the common part of all logarithms. On faces the step lowers the error of unseen shapes by a
    tenth, with twelve modes.

    The reference gives connectivity, shapes (n, V, 3) may be in any position, and ``steps`` is K of the logarithms.
    Returns the mean with the status of the elastic mean; without an exponential it is the elastic mean itself. Raises
    ModeError if less than the share ``reached`` of the shapes has a geodesic from the elastic mean.
    """
    with waiting("finding the mean shape"):
        found = elastic_mean(ShellSpace(reference, material), shapes)
    if found.status is not Status.CONVERGED:
        return found
    space = ShellSpace(reference.with_vertices(found.vertices), material, first_step=first_step)
    logs = logarithms(space, found.vertices, shapes, steps, workers)
    if len(logs.fallbacks) > (1 - reached) * len(shapes):
        raise ModeError(f"{len(logs.fallbacks)} of {len(shapes)} shapes have no geodesic from the mean")
    path = exponential(space, found.vertices, logs.fields.mean(axis=0), steps)
    return replace(found, vertices=path.vertices[-1]) if path.converged else found
