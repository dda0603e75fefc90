"""Reading a GLB by its specification, independently of the code that wrote it."""

import json
import struct
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

_COMPONENTS = {5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTH = {"SCALAR": 1, "VEC3": 3}
VALIDATOR = Path(__file__).parents[1] / "validate_gltf.mjs"


class GLB:
    def __init__(self, data: bytes) -> None:
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON"
        self.tree: dict[str, Any] = json.loads(data[20 : 20 + size])
        self._binary = data[28 + size :]
        self.primitive = self.tree["meshes"][0]["primitives"][0]

    def array(self, accessor: int) -> np.ndarray:
        a = self.tree["accessors"][accessor]
        view = self.tree["bufferViews"][a["bufferView"]]
        width = _WIDTH[a["type"]]
        flat = np.frombuffer(
            self._binary, _COMPONENTS[a["componentType"]], a["count"] * width, view.get("byteOffset", 0)
        )
        return flat.reshape(-1, width) if width > 1 else flat

    @property
    def positions(self) -> np.ndarray:
        return self.array(self.primitive["attributes"]["POSITION"])

    @property
    def faces(self) -> np.ndarray:
        return self.array(self.primitive["indices"]).reshape(-1, 3)

    def key(self, k: int, attribute: str = "POSITION") -> np.ndarray:
        """What a player shows at key k of the only animation."""
        sampler = self.tree["animations"][0]["samplers"][0]
        assert sampler["interpolation"] == "LINEAR"
        weights = self.array(sampler["output"]).reshape(len(self.array(sampler["input"])), -1)[k]
        targets = [self.array(target[attribute]) for target in self.primitive["targets"]]
        base = self.array(self.primitive["attributes"][attribute]).astype(np.float64)
        return base + np.tensordot(weights.astype(np.float64), np.array(targets), 1)

    @property
    def key_count(self) -> int:
        return len(self.array(self.tree["animations"][0]["samplers"][0]["input"]))


def khronos_report(path: Path) -> dict[str, Any]:
    """The Khronos validator's report."""
    found = subprocess.run(["node", VALIDATOR, path], capture_output=True, text=True, check=False)
    assert found.stdout, found.stderr
    report: dict[str, Any] = json.loads(found.stdout)
    return report
