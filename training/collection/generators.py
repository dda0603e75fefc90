"""The collections that a configuration can name: CollectionSettings.generator."""

from __future__ import annotations

from collections.abc import Callable

from shapespace.training.collection import figure
from shapespace.training.collection.freaky_torus import FreakyTorus
from shapespace.training.collection.mesh_collection import MeshCollection
from shapespace.training.runs.sampling import Collection


def figure_meshes() -> MeshCollection:
    """The figure in its poses; the first is the one at rest."""
    labels, vertices, faces = figure.poses()
    return MeshCollection(tuple(labels), vertices, faces)


#: Products of shape spaces by design: they give factors and bounds themselves, and skip `mean` and `modes`.
PRODUCTS: dict[str, Callable[[], Collection]] = {"freaky-torus": FreakyTorus}
#: Meshes in correspondence, as a folder holds them.
MESHES: dict[str, Callable[[], MeshCollection]] = {"figure": figure_meshes}
