"""Meshes, shapes and results are immutable values: code that holds one can't change it for others."""

import dataclasses
import importlib
import pkgutil

import pytest

ROOMS = [importlib.import_module(f"shapespace.{room}") for room in ("mesh", "coordinates", "shell", "solve", "files")]
MODULES = [
    importlib.import_module(f"{room.__name__}.{module.name}")
    for room in ROOMS
    for module in pkgutil.iter_modules(room.__path__)
]
VALUES = [
    kind
    for module in MODULES
    for kind in vars(module).values()
    if isinstance(kind, type) and dataclasses.is_dataclass(kind) and kind.__module__ == module.__name__
]


@pytest.mark.parametrize("kind", VALUES, ids=lambda kind: kind.__name__)
def test_values_stay_as_they_are(kind: type) -> None:
    value = object.__new__(kind)
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(value, dataclasses.fields(kind)[0].name, None)
