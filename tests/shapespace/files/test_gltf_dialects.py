"""glTF as some programs write it, beside the file as the specification has it."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest

from shapespace.files.reading import read_arrays
from tests.gltf_documents import BINARY, document, glb


def nulls() -> bytes:
    """Return a file with null for every member that is not there."""
    tree = json.loads(json.dumps(document()))
    tree["nodes"][0] |= dict.fromkeys(("children", "skin", "matrix", "rotation"))
    tree["meshes"][0]["primitives"][0] |= dict.fromkeys(("mode", "targets", "material"))
    return glb(tree, BINARY)


def decimals() -> bytes:
    """Return a file with 3.0 for 3."""
    tree = json.loads(json.dumps(document()), parse_int=float)
    return glb(tree, BINARY)


def no_stride() -> bytes:
    tree = json.loads(json.dumps(document()))
    tree["bufferViews"][0]["byteStride"] = 0
    return glb(tree, BINARY)


def rounded() -> bytes:
    return glb(document(nodes=[{"mesh": 0, "matrix": [*np.eye(4).ravel()[:15], 1.0000001]}]), BINARY)


def zeros_behind_the_text() -> bytes:
    data = bytearray(glb(document(extras="x" * 3), BINARY))
    end = 20 + int.from_bytes(data[12:16], "little")
    text = bytes(data[20:end]).rstrip()
    data[20:end] = text.replace(b'"xxx"', b'"x"').ljust(end - 20, b"\0")
    return bytes(data)


def no_zeros() -> bytes:
    """Return a file with a morph target that moves nothing, whose accessor has no data, as Blender may write it."""
    tree = json.loads(json.dumps(document()))
    tree["accessors"].append({"componentType": 5126, "type": "VEC3", "count": 4})
    tree["meshes"][0] |= {"weights": [1.0]}
    tree["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": len(tree["accessors"]) - 1}]
    return glb(tree, BINARY)


def needs_looks() -> bytes:
    names = [
        "KHR_animation_pointer",
        "KHR_xmp_json_ld",
        "VRMC_vrm",
        "VRM",
        "EXT_structural_metadata",
        "MSFT_texture_dds",
    ]
    return glb(document(extensionsRequired=names), BINARY)


@pytest.mark.parametrize("given", [nulls, decimals, no_stride, rounded, zeros_behind_the_text, no_zeros, needs_looks])
def test_dialects_are_read_as_the_plain_file_is(given: Callable[[], bytes]) -> None:
    for found, expected in zip(read_arrays(given(), "glb"), read_arrays(glb(document(), BINARY), "glb"), strict=True):
        np.testing.assert_array_equal(found, expected)
