"""Small glTF documents: a mesh of a few faces, under graphs of nodes of any form."""

import base64
import json
import struct

import numpy as np

#: A mesh of a few faces.
VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4")
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], "<u4")


def glb(tree: object, data: bytes = b"") -> bytes:
    text = tree if isinstance(tree, bytes) else json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if data:
        chunks += struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def document(**more: object) -> dict[str, object]:
    """A glTF document with a mesh in a buffer, and the given members; the scene's root is the first node."""
    return {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": VERTICES.nbytes + FACES.nbytes}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": VERTICES.nbytes},
            {"buffer": 0, "byteOffset": VERTICES.nbytes, "byteLength": FACES.nbytes},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": len(VERTICES)},
            {"bufferView": 1, "componentType": 5125, "type": "SCALAR", "count": FACES.size},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    } | more


BINARY = VERTICES.tobytes() + FACES.tobytes()
MATRIX = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 1, 0, 0, 1]


def chain(count: int, matrices: bool = True) -> bytes:
    """A chain of nodes, the last of which has the mesh."""
    extra = {"matrix": MATRIX} if matrices else {}
    nodes = [{"children": [k + 1], **extra} for k in range(count - 1)]
    return glb(document(nodes=[*nodes, {"mesh": 0}]), BINARY)


def doubling(deep: int) -> bytes:
    """Nodes that have the next one as child twice: a thousand million paths in a kilobyte."""
    return glb(document(nodes=[*({"children": [k + 1, k + 1]} for k in range(deep)), {"mesh": 0}]), BINARY)


def ring() -> bytes:
    """A node that is its own descendant."""
    return glb(document(nodes=[{"children": [1], "mesh": 0}, {"children": [0]}]), BINARY)


def graph(count: int) -> bytes:
    """Half of the nodes have all others as children: count² / 4 paths."""
    half = count // 2
    nodes = [
        {"children": list(range(1, half))},
        *({"children": list(range(half, count)), "matrix": MATRIX} for _ in range(1, half)),
        *({} for _ in range(half, count - 1)),
        {"mesh": 0},
    ]
    return glb(document(nodes=nodes), BINARY)


def embedded(data: bytes, **more: object) -> bytes:
    tree = document(**more)
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    tree["buffers"] = [{"byteLength": len(data), "uri": uri}]
    return json.dumps(tree, separators=(",", ":")).encode()
