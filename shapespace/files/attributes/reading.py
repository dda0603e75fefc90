"""Reading the attributes of a file of the user's own. Each part that can't be kept is left out, with a sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shapespace.files.attributes import gltf, obj, ply
from shapespace.files.limits import as_utf8, reason
from shapespace.files.mni_reading import is_mni
from shapespace.files.recognition import START, decide
from shapespace.mesh.attributes import MeshAttributes
from shapespace.mesh.triangle_mesh import MeshError

_READERS = {"glb": gltf.read, "gltf": gltf.read, "obj": obj.read, "ply": ply.read}
#: Formats whose files can have attributes.
FORMATS = tuple(_READERS)


def read_attributes(path: Path) -> tuple[MeshAttributes | None, list[str]]:
    """Read the attributes of a mesh file, for the vertices that `reading.read_arrays` returns.

    Returns:
        The attributes, or None if the file has only triangles; and a sentence on each part that is left out.

    Raises:
        OSError: the file can't be read.
    """
    if path.exists() and not path.is_file():
        raise OSError(f"{path} is no file")
    faults: list[str] = []
    try:
        with np.errstate(all="ignore"):
            with path.open("rb") as file:
                start = as_utf8(memoryview(file.read(START)))
            if is_mni(bytes(start)):
                return None, []
            surface = _READERS[decide(start, FORMATS, path.name).name](path, faults)
        surface.check(
            int(surface.corners.max()) + 1 if surface.colors is None else len(surface.colors), surface.triangles
        )
    except OSError:
        raise
    except Exception as error:  # damaged files raise exceptions of many classes
        what = str(error) if isinstance(error, MeshError) else f"it can't be understood: {reason(error)}"
        return None, [f"its polygons, texture coordinates and materials are left out: {what}"]
    return (None if surface.is_plain else surface), faults
