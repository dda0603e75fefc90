"""Every format that mesh files are written in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.attributes.obj import write_obj, write_obj_zip
from shapespace.files.attributes.ply import write_ply
from shapespace.files.colouring import Colouring
from shapespace.files.gltf_writing import write_glb, write_gltf
from shapespace.files.npz import npz_bytes
from shapespace.files.reading import OCTET_STREAM, READ_FORMATS
from shapespace.files.usd import still_usd
from shapespace.files.vtk_writing import write_vtk, write_vtp
from shapespace.mesh.attributes import MeshAttributes

#: A function that writes one mesh, see `MeshFormat.encode`.
MeshWriter = Callable[[FloatArray, IntArray, Colouring | None, MeshAttributes | None], bytes]


@dataclass(frozen=True)
class MeshFormat:
    """A file format for one mesh."""

    media_type: str  # media type as registered at IANA; OCTET_STREAM for formats without a registration
    write: MeshWriter  # writer of the format
    coloured: bool = True  # whether files can have colours; otherwise they are left out
    polygons: bool = False  # whether files can have polygons; otherwise faces are written as triangles

    def encode(
        self,
        vertices: FloatArray,
        faces: IntArray,
        colouring: Colouring | None = None,
        surface: MeshAttributes | None = None,
    ) -> bytes:
        """Return a mesh as the content of a file; positions (V, 3) in any unit become float32."""
        return self.write(vertices, faces, colouring, surface)


def _write_stl(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None, surface: MeshAttributes | None
) -> bytes:
    import trimesh

    content = trimesh.Trimesh(vertices.astype(np.float32), faces, process=False).export(file_type="stl")
    return content if isinstance(content, bytes) else str(content).encode()


def _write_npz(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None, surface: MeshAttributes | None
) -> bytes:
    arrays: dict[str, np.ndarray] = {"vertices": vertices.astype(np.float32), "faces": faces.astype(np.int32)}
    if colouring:
        arrays |= {
            "color_quantity": np.array(str(colouring.quantity)),
            "color_range": np.array(colouring.ends),
            "color_values": colouring.values.astype(np.float32),
        }
    return npz_bytes(arrays)


#: Every mesh format by its name, which is also the extension of its files. The first is the default.
MESH_FORMATS: dict[str, MeshFormat] = {
    "glb": MeshFormat(READ_FORMATS["glb"], write_glb),
    "gltf": MeshFormat(READ_FORMATS["gltf"], write_gltf),
    "obj": MeshFormat(READ_FORMATS["obj"], write_obj, polygons=True),
    "ply": MeshFormat(READ_FORMATS["ply"], write_ply, polygons=True),
    "stl": MeshFormat(READ_FORMATS["stl"], _write_stl, coloured=False),
    "npz": MeshFormat(READ_FORMATS["npz"], _write_npz),
}
#: An archive of an OBJ file with its materials and textures. It is not read.
OBJ_ZIP = MeshFormat("application/zip", write_obj_zip, polygons=True)
#: Binary USD files, which are not read. Writing them needs the package ``usd-core``.
USD_FORMATS = {
    "usd": MeshFormat(OCTET_STREAM, still_usd, polygons=True),
    "usdz": MeshFormat("model/vnd.usdz+zip", partial(still_usd, packed=True), polygons=True),
}
#: VTK's files of polygons, legacy and XML. Writing them needs the package ``vtk``.
VTK_FORMATS = {
    "vtk": MeshFormat(READ_FORMATS["vtk"], write_vtk, polygons=True),
    "vtp": MeshFormat(READ_FORMATS["vtp"], write_vtp, polygons=True),
}
