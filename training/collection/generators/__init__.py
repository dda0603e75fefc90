"""Built-in generators of collections, by the names for `CollectionSettings.generator`."""

from __future__ import annotations

from collections.abc import Callable

from shapespace.training.collection.generators import figure
from shapespace.training.collection.generators.freaky_torus import FreakyTorus
from shapespace.training.collection.generators.people import expressive_meshes, people_meshes
from shapespace.training.collection.mesh_collection import MeshCollection
from shapespace.training.runs.sampling import Collection


def figure_meshes() -> MeshCollection:
    """Return the figure in its poses, first the rest pose."""
    labels, vertices, faces = figure.poses()
    return MeshCollection(tuple(labels), vertices, faces)


#: Products of shape spaces by design: they give factors and bounds themselves, so the run skips `mean` and `modes`.
PRODUCTS: dict[str, Callable[[], Collection]] = {"freaky-torus": FreakyTorus}
#: Generators of meshes in correspondence, as a folder holds them.
MESHES: dict[str, Callable[[], MeshCollection]] = {
    "figure": figure_meshes,
    "expressive": expressive_meshes,
    "people": people_meshes,
}
