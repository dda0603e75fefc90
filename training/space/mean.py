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


def centred_mean(
    reference: TriangleMesh,
    shapes: FloatArray,
    material: Material,
    steps: int,
    workers: int = -1,
    first_step: FirstStep = "centred",
) -> Mean:
    """Compute the elastic mean, moved by the mean of the logarithms there.

    This is one step of Karcher's iteration towards the Riemannian centre of mass (paper, section 3). Without it, one
    mode would be spent on the common part of all logarithms. On faces the step lowers the error of unseen shapes by a
    tenth, with twelve modes.

    The reference gives connectivity, shapes (n, V, 3) may be in any position, and ``steps`` is K of the logarithms.
    Returns the mean with the status of the elastic mean; without an exponential it is the elastic mean itself.
    """
    with waiting("finding the mean shape"):
        found = elastic_mean(ShellSpace(reference, material), shapes)
    if found.status is not Status.CONVERGED:
        return found
    space = ShellSpace(reference.with_vertices(found.vertices), material, first_step=first_step)
    common = logarithms(space, found.vertices, shapes, steps, workers).fields.mean(axis=0)
    path = exponential(space, found.vertices, common, steps)
    return replace(found, vertices=path.vertices[-1]) if path.converged else found
