"""What the programs share: ``--version``, refusal of unknown arguments, and a sentence on missing packages."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any, NoReturn

from shapespace import __version__

#: Exit code of a command line that can't be carried out, as argparse has it.
USAGE = 2


class CommandParser(argparse.ArgumentParser):
    """A parser with ``--help`` and ``--version``. Options can't be shortened, so a mistyped one is refused.

    Args:
        advice: ends the message about an argument that is refused.
        options: of argparse.
    """

    def __init__(self, *, advice: str = "", **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)
        self._advice = advice
        self.add_argument("--version", action="version", version=f"shapespace {__version__}")

    def error(self, message: str) -> NoReturn:
        """End the program with the usage, a sentence and exit code 2."""
        super().error(f"{message}. {self._advice}" if self._advice else message)


def missing_packages(modules: Sequence[str], extra: str) -> str:
    """Return a sentence about modules that aren't installed and the extra that has them; empty if all are there."""
    missing = ", ".join(name for name in modules if not _is_installed(name))
    return f"needs {missing}, which is not installed here: pip install 'shapespace[{extra}]'" if missing else ""


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except (ImportError, ValueError):
        return False
