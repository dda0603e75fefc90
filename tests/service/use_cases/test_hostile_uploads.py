"""Uploads made to be expensive: a process with limits reads them, and the server goes on."""

import os
import re
import subprocess
import sys
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from shapespace.files.limits import Limits
from shapespace.service.limits.sandbox import READ, Sandbox
from shapespace.service.refusals import RefusedError
from shapespace.service.use_cases.codes import Upload, read_upload
from shapespace.solve.deadline import Deadline
from tests.faults.serving import peak_memory
from tests.gltf_documents import BINARY, chain, document, doubling, glb, graph, ring
from tests.hostile import HOSTILE, MIB, MOST
from tests.service.bundles import write_bundle
from tests.service.conftest import Server, starting

ENCODE = "/v1/models/small/encode"


#: Seconds that reading may take: far more than it needs, even on a busy machine.
SECONDS = 300.0
#: Bytes of an attack here. `tests/faults/on_requests.py` sends them with up to 64 MiB to a server.
SIZES = [2 * MIB, pytest.param(16 * MIB, marks=pytest.mark.long)]
#: Limits of a model with meshes no larger than this.
LIMITS = Limits(2**15, 2**16)


@pytest.fixture(scope="module")
def sandbox() -> Iterator[Sandbox]:
    with Sandbox(1, READ) as sandbox:
        yield sandbox


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", HOSTILE)
def test_an_attack_is_refused_in_one_sentence_or_read_as_the_mesh_it_holds(
    name: str, size: int, sandbox: Sandbox
) -> None:
    said, body = HOSTILE[name](size)
    assert len(body) <= MOST
    form = "/" in said
    upload = Upload(deque([memoryview(body)]), said if form else "", None if form else said)
    sentence = ""
    try:
        ((vertices, faces, _),), _ = read_upload(sandbox, upload, LIMITS, Deadline(SECONDS))
    except RefusedError as error:
        sentence = str(error)
    assert (sentence and "\n" not in sentence and len(sentence) < 400) or (
        0 < len(vertices) <= LIMITS.vertices and len(faces) <= LIMITS.faces
    )


def test_the_reader_is_light() -> None:
    """The process that only reads files needs no server, networks or sparse matrices."""
    heavy = ("fastapi", "starlette", "pydantic", "onnxruntime", "torch", "trimesh", "scipy")
    module = "shapespace.service.use_cases.uploads"
    program = f"import sys, {module}; print([name for name in {heavy} if name in sys.modules])"
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "[]"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    models = tmp_path_factory.mktemp("hostile") / "models"
    write_bundle(models, "small")
    with starting() as start:
        yield start(models, workers=2)


def processor_seconds(server: Server) -> float:
    fields = Path(f"/proc/{server.process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")  # user and system time


SPARSE = {"count": 10**9, "indices": {"bufferView": 1, "componentType": 5125}, "values": {"bufferView": 0}}
ACCESSORS = [
    {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 4, "sparse": SPARSE},
    {"bufferView": 1, "componentType": 5125, "type": "SCALAR", "count": 12},
]
#: Scene graphs that once stopped the server, with their sizes in bytes and the messages expected now.
GRAPHS = {
    "a chain of 3000 nodes with matrices": (lambda: chain(3000), 230_000, "more than 100 deep"),
    "a graph of nodes": (lambda: graph(800), 800_000, "lies in two others"),
    "nodes that double": (lambda: doubling(30), 2000, "lies in two others"),
    "a ring": (ring, 1000, "lies in another one"),
    "a sparse accessor": (lambda: glb(document(accessors=ACCESSORS), BINARY), 1000, "not enough data"),
    "an extension": (lambda: glb(document(extensionsRequired=["EXT_x"]), BINARY), 1000, "it requires EXT_x, which"),
}


@pytest.mark.parametrize("name", GRAPHS)
def test_scenes_that_brought_the_server_down(name: str, small: Server) -> None:
    make, size, says = GRAPHS[name]
    body = make()
    assert 0.5 * size < len(body) < 1.2 * size
    memory, seconds = peak_memory(small), processor_seconds(small)
    with httpx.Client(base_url=small.url, timeout=120) as client:
        answer = client.post(ENCODE, params={"format": "glb"}, content=body)
        assert answer.status_code == 422
        assert answer.json()["type"] == "urn:shapespace:problem:invalid-mesh"
        assert re.search(says, answer.json()["detail"])
    assert peak_memory(small) < memory + len(body) + 64 * MIB
    assert processor_seconds(small) < seconds + 5
