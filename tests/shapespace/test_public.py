"""``import shapespace``: public names, each with an example that runs, and lazy imports."""

import builtins
import doctest
import importlib
import inspect
import re
import subprocess
import sys
from enum import StrEnum
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
        if inspect.isclass(value) and issubclass(value, Exception | StrEnum):
            assert inspect.getdoc(value)
        else:
            assert examples(value) or re.search(rf"shapespace\.{name}\b", tour), name
    for name, method in vars(shapespace.ShapeModel).items():
        if inspect.isfunction(method) and not name.startswith("_"):
            assert f"model.{method.__name__}(" in examples(method)  # `fit` and `spread` are old names
    with pytest.raises(AttributeError, match="has no attribute 'unknown'"):
        shapespace.unknown  # noqa: B018


def raised(documented: object) -> set[str]:
    """Names of the errors in the section ``Raises`` of a docstring."""
    _, _, section = (inspect.getdoc(documented) or "").partition("Raises:\n")
    names = re.findall(r"^    (\w+(?:, \w+)*): ", section.partition("\n\n")[0], re.MULTILINE)
    return {name for several in names for name in several.split(", ")}


def test_every_error_that_a_public_docstring_names_is_public() -> None:
    found: dict[str, set[str]] = {}
    for name in shapespace.__all__:
        value = getattr(shapespace, name)
        if not inspect.isclass(value):
            found[name] = raised(value)
        elif not issubclass(value, Exception):
            methods = {key: getattr(value, key) for key in vars(value) if not key.startswith("_")}
            found |= {f"{name}.{key}": raised(method) for key, method in methods.items()} | {name: raised(value)}
    assert found["ShapeModel.encode"] == {"InvalidMeshError", "LatentError", "MeshError", "ModelFailedError"}
    known = {*shapespace.__all__, *vars(builtins)}
    assert {name: errors - known for name, errors in found.items() if errors - known} == {}


def test_options_go_by_name_or_as_one_object() -> None:
    options = shapespace.EncodeOptions.of(shapespace.EncodeOptions(samples=3), {"objective": "nric"})
    assert (options.samples, options.objective) == (3, shapespace.Objective.NRIC)
    assert shapespace.EncodeOptions.of(None, {}) == shapespace.EncodeOptions()
    with pytest.raises(TypeError, match="must be EncodeOptions, not 'clamp'\\. Pass single options by name"):
        shapespace.EncodeOptions.of("clamp", {})  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="prior"):
        shapespace.EncodeOptions.of(None, {"prior": 1})
    with pytest.raises(ValueError, match="'neither' is not a valid Bounds"):
        shapespace.EncodeOptions.of(None, {"bounds": "neither"})


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
    if not shapespace._MODULES[name].startswith(("bundle.", "model.")):
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
