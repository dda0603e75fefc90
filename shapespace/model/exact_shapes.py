"""Exact shapes: the discrete exponentials that the networks approximate."""

import queue
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.model.decoder import Decoder, MeshChoice
from shapespace.model.latent_space import Codes
from shapespace.shell.energy import Material
from shapespace.shell.exponential import exponential
from shapespace.shell.space import ShellSpace
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Status


class NoTangentSpaceError(ValueError):
    """A model whose codes are not tangent vectors."""


@dataclass(frozen=True)
class ExactShape:
    """Discrete exponential of one code."""

    status: Status  # how the solver ended
    # (V, 3) float32, aligned to the reference, in the units of the training meshes; None if it failed
    vertices: NDArray[np.float32] | None
    # mean, max: distance of the networks' shape from ``vertices``; None if it failed
    mean: float | None
    max: float | None


def require_tangent_space(model: Decoder) -> tuple[FloatArray, int]:
    """Return the modes (m, V, 3) and K of a model; raises NoTangentSpaceError if it has no tangent space."""
    if model.modes is None or model.manifest.exponential_steps is None:
        raise NoTangentSpaceError(
            f"The codes of {model.manifest.name} are not tangent vectors, so it has no exact exponentials. "
            'Leave out "exact".'
        )
    return model.modes, model.manifest.exponential_steps


def exact_shape(
    model: Decoder, code: Codes, answer: NDArray[np.float32], mesh: MeshChoice, deadline: Deadline | None = None
) -> ExactShape:
    """Compute the exponential ``exp_z̄(Σ_j code_j u_j)`` in K steps, as the model's manifest says.

    The networks give the shape ``answer`` (V, 3) for the code (m,), on the mesh of choice. After the deadline the
    status is Status.DEADLINE.
    """
    modes, steps = require_tangent_space(model)
    velocity = np.tensordot(code.astype(np.float64), modes, axes=1)
    try:
        space = model.spaces.get_nowait()
    except queue.Empty:
        manifest = model.manifest
        material = Material(manifest.mu, manifest.lambda_, manifest.eta)
        space = ShellSpace(model.reference, material, first_step=manifest.exponential_first_step)
    try:
        path = exponential(space, model.reference.vertices, velocity, steps, deadline=deadline)
    finally:
        model.spaces.put(space)
    if not path.converged:
        return ExactShape(path.status, None, None, None)
    vertices = model.finish(path.vertices[-1], mesh)
    distances = np.linalg.norm(vertices - answer, axis=1)
    return ExactShape(path.status, vertices.astype(np.float32), float(distances.mean()), float(distances.max()))
