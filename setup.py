"""The settings are in pyproject.toml. Importing shapespace here rejects checkouts without symbolic links."""

import sys
from pathlib import Path

from setuptools import setup

sys.path.insert(0, str(Path(__file__).parent))
try:
    import shapespace  # noqa: F401
except ImportError as error:
    raise SystemExit(str(error)) from None
setup()
