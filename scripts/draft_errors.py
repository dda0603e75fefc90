"""Measure the error of drafts of old bundles, and write it into their manifests. An export measures it by itself.

Usage: ``python -m scripts.draft_errors models/NAME/VERSION …``.
"""

import json
import sys
from pathlib import Path

from shapespace.bundle.schema import MANIFEST
from shapespace.model.shape_model import load

if __name__ == "__main__":
    for folder in map(Path, sys.argv[1:]):
        found = load(folder).decoder.draft_error()
        path = folder / MANIFEST
        facts = json.loads(path.read_text(encoding="utf-8"))
        origin, files = facts.pop("origin"), facts.pop("files")
        facts |= {"draft_error": found, "origin": origin, "files": files}
        path.write_text(json.dumps(facts, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
