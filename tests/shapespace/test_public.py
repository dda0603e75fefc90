"""``import shapespace``: public names, each with an example that runs, and lazy imports."""

import doctest
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import shapespace

ROOT = Path(__file__).parents[2]
LIBRARY = ROOT / "shapespace"
#: Modules whose examples run here; the client's need a server, and test_blocks.py runs those of the pages.
MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for path in LIBRARY.rglob("*.py")
    if path.relative_to(LIBRARY).parts[0] not in {"service", "training", "client.py"} and ">>> " in path.read_text()
)


@pytest.mark.parametrize("name", MODULES)
def test_examples(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    failed, tried = doctest.testmod(importlib.import_module(name))
    assert tried
    assert not failed


def examples(documented: object) -> str:
    return "".join(example.source for example in doctest.DocTestParser().get_examples(inspect.getdoc(documented) or ""))


def test_every_public_name_is_there_and_has_an_example() -> None:
    assert set(shapespace.__all__) == set(shapespace._MODULES)
    assert set(shapespace.__all__) <= set(dir(shapespace))
    tour = examples(shapespace)
    for name in shapespace.__all__:
        value = getattr(shapespace, name)
        assert value.__name__ == name
        assert examples(value) or re.search(rf"shapespace\.{name}\b", tour), name
    for name, method in vars(shapespace.ShapeModel).items():
        if inspect.isfunction(method) and not name.startswith("_"):
            assert f"model.{name}(" in examples(method)
    with pytest.raises(AttributeError, match="has no attribute 'unknown'"):
        shapespace.unknown  # noqa: B018


def test_nothing_is_imported_before_it_is_used() -> None:
    program = """
import sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"distributed", "fastapi", "httpx", "joblib", "numpy", "onnx", "onnxruntime",
                                  "pydantic", "scipy", "torch", "trimesh"} - ALLOWED:
            raise ModuleNotFoundError(f"{name} is refused", name=name)
ALLOWED = set()
sys.meta_path.insert(0, Refuse())
import shapespace
assert [name for name in sys.modules if name.startswith("shapespace")] == ["shapespace"]
ALLOWED |= {"numpy", "scipy"}
for name in shapespace.__all__:
    if name not in {"load", "ShapeModel"}:
        getattr(shapespace, name)
try:
    shapespace.load
except ModuleNotFoundError as error:
    assert str(error) == f"shapespace.load needs {error.name}: pip install 'shapespace[model]'", error
else:
    raise AssertionError("it has imported what is refused")
ALLOWED |= {"onnx", "onnxruntime", "pydantic"}
shapespace.load(sys.argv[1])
"""
    folder = ROOT / "models" / "freaky-torus"
    subprocess.run([sys.executable, "-c", program, folder], cwd=ROOT, check=True)
