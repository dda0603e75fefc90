"""Every library imported, except NumPy and SciPy, is named in a contract of ``[tool.importlinter]``."""

import sys
import tomllib
from pathlib import Path

import grimp

CONTRACTS = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["tool"]["importlinter"]
FOR_ALL = {"numpy", "scipy"}


def test_every_library_is_under_a_contract() -> None:
    graph = grimp.build_graph("shapespace", include_external_packages=True, cache_dir=None)
    imported = {name for name in graph.modules if graph.is_module_squashed(name)} - sys.stdlib_module_names
    protected = [name for contract in CONTRACTS["contracts"] for name in contract.get("protected_modules", [])]
    assert sorted(protected) == sorted(imported - FOR_ALL)
