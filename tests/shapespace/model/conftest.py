"""Models that tests of searches for codes share."""

import pytest

from shapespace.model.shape_model import ShapeModel, load
from tests.service.bundles import write_bundle
from tests.service.conftest import ROOT


@pytest.fixture(scope="package")
def model(tmp_path_factory: pytest.TempPathFactory) -> ShapeModel:
    """A model of random networks with a finer mesh."""
    folder = tmp_path_factory.mktemp("with-fine")
    write_bundle(folder, "with-fine", fine=True)
    return load(folder / "with-fine")


@pytest.fixture(scope="package")
def figure() -> ShapeModel:
    """The bundled one."""
    return load(ROOT / "models" / "figure")
