"""docs/mathematics.md names functions: they are there, and none of the modules that compute is missing."""

import importlib
import re
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "mathematics.md"
NAMED = re.findall(r"`((?:tests\.)?shapespace(?:\.[a-z]\w*)+)\.(\w+)`", PAGE.read_text(encoding="utf-8"))


def test_every_function_of_the_page_exists() -> None:
    missing = [f"{module}.{name}" for module, name in NAMED if not hasattr(importlib.import_module(module), name)]
    assert not missing
    assert len(NAMED) > 30
