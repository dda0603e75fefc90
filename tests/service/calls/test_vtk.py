"""VTK's formats in answers and uploads of the server."""

import io
from collections import deque
from collections.abc import Mapping

import httpx
import numpy as np
import pytest

from shapespace.files.formats import VTK_FORMATS
from shapespace.files.limits import Limits
from shapespace.files.reading import read_arrays
from shapespace.service.limits.sandbox import READ, Sandbox
from shapespace.service.use_cases import shape_formats
from shapespace.service.use_cases.codes import Upload, read_upload
from shapespace.solve.deadline import Deadline
from tests.service.bundles import reference

MESH = "/v1/models/with-fine/mesh"


@pytest.mark.parametrize("format", VTK_FORMATS)
def test_shapes_are_answered_in_vtk(client: httpx.Client, format: str) -> None:
    query = {"latent": "0.1,0.7,0.4"}
    answer = client.get(MESH, params=query | {"format": format, "color": "stretch"}).raise_for_status()
    expected = np.load(io.BytesIO(client.get(MESH, params=query | {"format": "npz"}).raise_for_status().content))
    vertices, faces = read_arrays(answer.content, format)
    assert np.array_equal(vertices, expected["vertices"])
    assert np.array_equal(faces, expected["faces"])
    assert answer.headers["Content-Type"] == "application/octet-stream"
    assert b"stretch" in answer.content
    again = client.get(MESH, params=query | {"format": format}, headers={"If-None-Match": answer.headers["ETag"]})
    assert (again.status_code, again.headers["ETag"] != answer.headers["ETag"]) == (200, True), "colours are others"


def test_a_server_without_the_package_offers_no_vtk(monkeypatch: pytest.MonkeyPatch) -> None:
    def offered() -> Mapping[str, str]:
        return shape_formats.writable(dict.fromkeys(shape_formats.SHAPE_FORMATS, ""))

    assert VTK_FORMATS.keys() < offered().keys()
    monkeypatch.setattr(shape_formats, "vtk_installed", lambda: False)
    assert not VTK_FORMATS.keys() & offered().keys()
    for format in VTK_FORMATS:
        assert 'pip install "shapespace[vtk]"' in shape_formats.UNAVAILABLE[format]


@pytest.mark.parametrize("format", VTK_FORMATS)
def test_one_process_reads_several_files_within_its_memory(format: str) -> None:
    content = VTK_FORMATS[format].encode(reference().vertices, reference().faces)
    with Sandbox(1, READ) as sandbox:
        for _ in range(2):
            upload = Upload(deque([memoryview(content)]), "", None)
            meshes, _ = read_upload(sandbox, upload, Limits(10**5, 10**5), Deadline(300.0), points=True)
            assert np.array_equal(meshes[0].faces, reference().faces)
