"""Models shared by the tests of `encode`, `edit` and `fit`."""

import pytest

from shapespace.model.shape_model import ShapeModel, load
from tests.service.bundles import write_bundle
from tests.service.conftest import ROOT


@pytest.fixture(scope="package")
def model(tmp_path_factory: pytest.TempPathFactory) -> ShapeModel:
    """A model with random networks and a fine mesh."""
    folder = tmp_path_factory.mktemp("with-fine")
    write_bundle(folder, "with-fine", fine=True)
    return load(folder / "with-fine")


@pytest.fixture(scope="package")
def figure() -> ShapeModel:
    """The bundled figure."""
    return load(ROOT / "models" / "figure")
