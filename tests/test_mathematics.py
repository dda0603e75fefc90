"""docs/explanation/mathematics.md: the functions that it names exist, and it has every numerical module."""

import importlib
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "explanation" / "mathematics.md"
NAMED = re.findall(r"`((?:tests\.)?shapespace(?:\.[a-z]\w*)+)\.(\w+)(?:\.\w+)?`", PAGE.read_text(encoding="utf-8"))


def test_every_function_of_the_page_exists() -> None:
    missing = [f"{module}.{name}" for module, name in NAMED if not hasattr(importlib.import_module(module), name)]
    assert not missing
    assert len(NAMED) > 30


#: Packages with numerical modules.
ROOMS = {"shapespace": ("solve", "coordinates", "mesh", "shell", "model"), "training": ("space", "learning")}
#: Modules in them that implement no formula: they store, name, choose, run or write.
NO_MATHEMATICS = {
    "shapespace.solve.blas_threads",
    "shapespace.solve.deadline",
    "shapespace.mesh.attributes",
    "shapespace.mesh.vectors",
    "shapespace.mesh.vertex_order",
    "shapespace.model.choice",
    "shapespace.model.correspondence",
    "shapespace.model.encode_faults",
    "shapespace.model.fit_constraints",
    "shapespace.model.fit_preparation",
    "shapespace.model.fit_result",
    "shapespace.model.fit_settings",
    "shapespace.model.fit_verdict",
    "shapespace.model.inputs",
    "shapespace.model.latent_space",
    "shapespace.model.memory",
    "shapespace.model.network_operators",
    "shapespace.model.network_program",
    "shapespace.model.networks",
    "shapespace.model.options",
    "shapespace.model.shape",
    "shapespace.model.shape_model",
    "shapespace.training.learning.allocator",
    "shapespace.training.learning.decoder_graph",
    "shapespace.training.learning.device",
    "shapespace.training.learning.export",
    "shapespace.training.learning.graph_storage",
    "shapespace.training.learning.naming",
    "shapespace.training.space.straight_collection",
}


def test_every_module_that_computes_is_on_the_page() -> None:
    modules = {
        f"{'' if top == 'shapespace' else 'shapespace.'}{top}.{room}.{path.stem}"
        for top, rooms in ROOMS.items()
        for room in rooms
        for path in (ROOT / top / room).glob("*.py")
        if path.stem != "__init__"
    }
    named = {module for module, _ in NAMED}
    assert modules - named == NO_MATHEMATICS, "add the module to the page, or to NO_MATHEMATICS"
