"""Models shared by the tests of `encode`, `edit` and `fit`."""

from functools import cache

import pytest

from shapespace.model.fit_result import Fitted
from shapespace.model.shape_model import ShapeModel, load
from tests.service.bundles import write_bundle
from tests.service.conftest import ROOT
from tests.shapespace.model.moved_shapes import Moved, Plain


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


@pytest.fixture(scope="package")
def plain(figure: ShapeModel) -> Plain:
    """For a seed, a moved shape of the figure and the fit to its points without options; each is made once."""

    @cache
    def fitted(seed: int) -> tuple[Moved, Fitted]:
        given = Moved.of(figure, seed)
        return given, figure.fit_scan(given.points())

    return fitted
