"""``python -m tests.clients BLENDER_PYTHON``: open the server's files of all bundled models elsewhere.

A client in Java, which openapi-generator makes, calls the server too. ``make long clients`` installs Blender's package
and the generator in an environment of their own, and calls this.
"""

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import httpx

from tests.clients.files import write_files
from tests.clients.java import build, call
from tests.service.conftest import ROOT, starting

GENERATOR = "openapi-generator-cli"
HERE = Path(__file__).parent


def main(blender: str) -> bool:
    """Whether every program finds all vertices in the right place."""
    good = True
    with TemporaryDirectory() as scratch, starting() as start:
        models = Path(scratch, "models")
        models.symlink_to(ROOT / "models")
        server = start(models, deadline=600)
        with httpx.Client(base_url=server.url, timeout=600) as client:
            for model in [card["name"] for card in client.get("/v1/models").json()["models"]]:
                folder = Path(scratch, model)
                folder.mkdir()
                write_files(client, model, folder)
                print(f"{model}:", flush=True)
                for command in (["node", HERE / "three.mjs"], [blender, HERE / "blender.py"]):
                    # Blender prints much on standard output.
                    output = subprocess.DEVNULL if command[0] == blender else None
                    found = subprocess.run([*command, folder], stdout=output, check=False)
                    good &= found.returncode == 0
        print("client in Java:", call(build(Path(blender).with_name(GENERATOR), Path(scratch, "java")), server.url))
    return good


if __name__ == "__main__":
    sys.exit(not main(sys.argv[1]))
