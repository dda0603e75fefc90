"""Local fields: what the shapes of a collection do, each in one region alone.

A few shapes differ in few directions. An unseen shape may bend one limb as one of them does, and another limb as
another does. Local fields show such directions: a window keeps the turns and stretches of the faces in a region, and
fades out around it. The rest of the surface follows without turning or stretching. Added to the covariance of the
shapes, they lead modes to directions that the shapes do not have together (Wilms et al.,
"Multi-resolution multi-object statistical shape models based on the locality assumption", 2017; there with vertices).
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import without_rigid_motion
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.space.face_coordinates import FaceCoordinates

#: Standard deviation of a window, and largest distance from the nearest centre of a window, as a share of the diagonal.
WIDTH = 0.2
#: Most windows, for surfaces of many separate parts.
MOST_WINDOWS = 40
#: Where more modes are wanted than the shapes have, local fields add this share of the variance that held-out shapes
#: have outside the span of the others, so that the data's modes come first.
LOCAL_SHARE = 0.1
#: Bounds of codes have room for this number of standard deviations of that variance.
DEVIATIONS = 3.0


@dataclass(frozen=True)
class LocalVariation:
    """How much of the variance of modes comes from local fields."""

    share: float  # sum of the local fields' squares, as a share of the sum of the shapes' squares
    unseen: float  # variance of held-out shapes outside the span of the other shapes, as a share of theirs

    def room(self, spread: FloatArray) -> FloatArray:
        """Return how far codes may go along modes, from their standard deviations (m,) by local fields."""
        return DEVIATIONS * np.sqrt(self.unseen / self.share) * spread


def windows(mesh: TriangleMesh) -> FloatArray:
    """Return windows (k, F) on the faces of a mesh, whose squares add up to 1 at each face.

    A window is a Gaussian of the distance along the surface from its centre. Centres are chosen one by one, each the
    face farthest from the others. Separate parts are as far apart as their centres are in space.
    """
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    first, second = mesh.connectivity.edge_faces[mesh.connectivity.hinge_edges].T
    lengths = np.linalg.norm(centres[first] - centres[second], axis=1)
    links = sparse.coo_array((lengths, (first, second)), (len(centres), len(centres))).tocsr()

    def distances(face: int) -> FloatArray:
        along = dijkstra(links, directed=False, indices=np.array(face))
        apart = np.linalg.norm(centres - centres[face], axis=1)
        return np.where(np.isfinite(along), along, apart) / mesh.diagonal

    found = [distances(int(np.linalg.norm(centres - centres.mean(axis=0), axis=1).argmin()))]
    while len(found) < MOST_WINDOWS and (nearest := np.min(found, axis=0)).max() > WIDTH:
        found.append(distances(int(nearest.argmax())))
    shifted = np.array(found) ** 2 - np.min(found, axis=0) ** 2  # so that no face is outside all windows
    heights = np.exp(-shifted / (2 * WIDTH**2))
    return heights / np.linalg.norm(heights, axis=0)


def local_fields(mesh: TriangleMesh, fields: FloatArray) -> FloatArray:
    """Return the local fields (n, k, V, 3) of vertex fields (n, V, 3) at a mesh, without rigid motion."""
    coordinates, some = FaceCoordinates(mesh), windows(mesh)
    at_rest = np.zeros(len(coordinates.weights))
    turned = coordinates.along(fields).reshape(len(fields), 1, len(mesh.faces), -1) * some[:, :, None]
    found = coordinates.change(at_rest, turned.reshape(-1, len(at_rest)))
    return without_rigid_motion(found, mesh.vertices).reshape(len(fields), len(some), *mesh.vertices.shape)


def scale_of(local: FloatArray, rows: FloatArray, share: float) -> float:
    """Return the factor of local fields that makes their squares this share of the shapes' squares, both as rows."""
    return float(np.sqrt(share * (rows**2).sum() / (local**2).sum()))
