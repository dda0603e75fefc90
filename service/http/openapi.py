"""``python -m shapespace.service.http.openapi`` writes ``openapi/openapi.json``."""

from __future__ import annotations

import json
from pathlib import Path

from shapespace.service.http.app import create_app
from shapespace.service.settings import Settings

TARGET = Path(__file__).parents[3] / "openapi" / "openapi.json"


def document() -> str:
    """Return the text of ``openapi/openapi.json``."""
    return json.dumps(create_app(Settings()).openapi(), indent=2, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    TARGET.write_text(document(), encoding="utf-8")
    print(f"{TARGET.name} written")
