"""Size of the shape in windows of all sizes."""

import numpy as np
import pytest

from tests.page.conftest import Visit
from tests.page.studio import pixels


@pytest.mark.parametrize(
    ("width", "height", "least"),
    [
        (390, 844, 0.35),
        (844, 390, 0.45),
        *(
            pytest.param(*some, marks=pytest.mark.long)
            for some in ((640, 360, 0.45), (320, 568, 0.25), (1440, 900, 0.65))
        ),
    ],
)
def test_the_figure_is_large_and_nothing_lies_over_it(visit: Visit, width: int, height: int, least: float) -> None:
    studio = visit("#model=figure", size=(width, height))
    stage = studio[".stage"].bounding_box()
    assert stage
    assert stage["height"] >= 0.48 * height
    for words in (".tools", ".status"):
        studio[words].evaluate("e => { e.style.visibility = 'hidden'; }")
    box = studio["#canvas"].bounding_box()
    picture = pixels(studio.page.screenshot(clip=box))
    rows = np.flatnonzero((np.abs(picture - picture[0, 0]).max(axis=2) > 40).any(axis=1))
    assert np.ptp(rows) >= least * height
    tools, status = studio[".tools"].bounding_box(), studio[".status"].bounding_box()
    assert tools
    assert status
    assert tools["y"] + tools["height"] <= stage["y"] + rows[0]
    assert stage["y"] + rows[-1] <= status["y"] + 8  # the text's padding
    assert studio.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert studio["#tab-shape"].evaluate("e => e.scrollWidth <= e.clientWidth")
