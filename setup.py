"""Everything is said in pyproject.toml; this refuses checkouts in which the rooms of `shapespace/` would be missing."""

from pathlib import Path

from setuptools import setup

for name in ("models", "service", "training"):
    if Path("shapespace", name).is_file():
        raise SystemExit(
            f"shapespace/{name} is a text file where a link to ../{name} should be: git made this checkout without "
            "links. On Windows switch on developer mode, then run `git config core.symlinks true` and "
            "`git checkout -- shapespace`."
        )
setup()
