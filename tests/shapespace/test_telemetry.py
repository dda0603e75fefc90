"""ONNX Runtime reports nothing."""

import os
import subprocess
import sys
from pathlib import Path


def test_onnx_runtime_prepares_no_reports(tmp_path: Path) -> None:
    left = ("CI", "ORT_", "XDG_", "GITHUB_")  # variables that also end or move its reports
    environment = {name: value for name, value in os.environ.items() if not name.startswith(left)}
    loads = "import shapespace; shapespace.load('freaky-torus')"
    subprocess.run([sys.executable, "-c", loads], env=environment | {"HOME": str(tmp_path)}, check=True)
    # Its reports begin with the id of the device in a file there.
    assert not [path for path in tmp_path.rglob("*") if "onnxruntime" in path.name]
