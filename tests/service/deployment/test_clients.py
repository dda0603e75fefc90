"""three.js opens files of the server; ``make long clients`` does the same in Blender."""

import json
import subprocess
from pathlib import Path

import httpx

from tests.clients.files import write_files

THREE = Path(__file__).parents[2] / "clients" / "three.mjs"


def test_three_js_sees_every_vertex_where_it_should_be(client: httpx.Client, tmp_path: Path) -> None:
    write_files(client, "with-fine", tmp_path)
    seen = subprocess.run(["node", THREE, tmp_path], capture_output=True, text=True, check=False)
    assert seen.returncode == 0, seen.stdout + seen.stderr
    assert [line.split()[1] for line in seen.stdout.splitlines()] == [
        "shape.glb:", "colored.glb:", "animation.glb:", "long.glb:"
    ]  # fmt: skip

    expected = json.loads((tmp_path / "expected.json").read_text())
    expected["animation"]["vertices"][2][7][1] += 1e-3
    (tmp_path / "expected.json").write_text(json.dumps(expected))
    wrong = subprocess.run(["node", THREE, tmp_path], capture_output=True, text=True, check=False)
    assert wrong.returncode == 1, "a vertex in the wrong place must be detected"
    assert wrong.stdout.count("WRONG") == 1
