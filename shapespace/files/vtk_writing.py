"""Writer of VTK's legacy and XML files of polygons, by the package ``vtk``."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.colouring import Colouring
from shapespace.mesh.attributes import MeshAttributes

if TYPE_CHECKING:
    from vtkmodules.vtkCommonCore import vtkDataArray
    from vtkmodules.vtkCommonDataModel import vtkPolyData

#: Version of legacy files that every program reads. Few programs other than VTK read version 5.
_LEGACY_VERSION = 42


@cache
def vtk_installed() -> bool:
    """Return whether the package ``vtk`` is installed. Looked for once, because a look takes 0.1 ms."""
    return find_spec("vtkmodules") is not None


def write_vtk(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    """Write one mesh as a binary legacy file; see `MeshFormat.encode`.

    Vertex colours are the array RGB of the points. Values of a colouring are an array with the name of the quantity.
    """
    from vtkmodules.vtkIOLegacy import vtkPolyDataWriter

    writer = vtkPolyDataWriter()
    writer.SetFileVersion(_LEGACY_VERSION)
    writer.SetFileTypeToBinary()
    writer.SetHeader("polygons")
    writer.SetInputData(_polygons(vertices, faces, colouring, surface))
    writer.WriteToOutputStringOn()
    writer.Write()
    content: str | bytes = writer.GetOutputStdString()  # the package decodes content that happens to be UTF-8
    return content if isinstance(content, bytes) else content.encode()


def write_vtp(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    """Write one mesh as a compressed XML file, with the content that `write_vtk` writes."""
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(_polygons(vertices, faces, colouring, surface))
    writer.WriteToOutputStringOn()
    writer.Write()
    return writer.GetOutputString().encode()


def _polygons(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None, surface: MeshAttributes | None
) -> vtkPolyData:
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    surface = surface or MeshAttributes.of_triangles(faces)
    mesh, points, cells = vtkPolyData(), vtkPoints(), vtkCellArray()
    points.SetData(_array(vertices.astype(np.float32)))
    offsets, corners = (_array(array.astype(np.int64)) for array in (surface.starts, surface.corners))
    cells.SetData(offsets, corners)
    mesh.SetPoints(points)
    mesh.SetPolys(cells)
    arrays = {}
    if colouring:
        arrays[str(colouring.quantity)] = colouring.values.astype(np.float32)
    colors = colouring.srgb if colouring else surface.colors
    if colors is not None:
        arrays["RGB"] = np.rint(255 * colors).astype(np.uint8)
    for name, values in arrays.items():
        array = _array(values)
        array.SetName(name)
        mesh.GetPointData().AddArray(array)
    if arrays:
        mesh.GetPointData().SetActiveScalars(next(iter(arrays)))
    return mesh


def _array(values: NDArray) -> vtkDataArray:
    from vtkmodules.util.numpy_support import numpy_to_vtk

    return numpy_to_vtk(np.ascontiguousarray(values), deep=True)  # type: ignore[no-untyped-call]
