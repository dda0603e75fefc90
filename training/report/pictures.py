"""Pictures of a run's shapes as HTML elements, and the colours of the report."""

from __future__ import annotations

import base64
import importlib.util
import io
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.colors import Colormap, LinearSegmentedColormap, to_hex, to_rgb
from numpy.typing import NDArray
from PIL import Image

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.rigid_motion import align
from shapespace.training.report.record import Record
from shapespace.training.report.rendering import Camera

#: Largest displacement in the picture of a mode, as a share of the diagonal.
MODE_REACH = 0.1
#: Colours of exact shapes, of shapes from networks (yellow as in the paper), and of modes without a factor.
CLAY, COMPOSITE, NEUTRAL = "#d3ccc1", "#e3b23c", "#4b5a6b"
ERROR = LinearSegmentedColormap.from_list("error", [CLAY, "#f2c14e", "#e4572e", "#8f1440"])


@dataclass(frozen=True)
class Studio:
    """A camera and colours for all shapes of one run."""

    camera: Camera  # a view that holds every shape of the run
    base: FloatArray  # (V, 3) shape that all other shapes are aligned to
    faces: IntArray  # (F, 3)

    @classmethod
    def of(cls, record: Record) -> Studio | None:
        """Set up the camera; return None without a shape to draw, or without the package ``embreex``."""
        if record.base is None or importlib.util.find_spec("embreex") is None:
            return None
        base, faces = record.base.astype(np.float64), record.reference["faces"]
        names = {"random", "test_exact", "test_predicted", "strip_joint", "strip_factors"} & record.gallery.keys()
        shapes = [align(record.gallery[name].reshape(-1, *base.shape), base) for name in sorted(names)]
        return cls(Camera.facing(base, faces, np.concatenate([base[None], *shapes])), base, faces)

    def closer(self, reference: FloatArray) -> Studio:
        """Return the same view, cut to the base, the reference and modes, which need less room than other shapes."""
        points = np.concatenate([self.base, align(reference, self.base)])
        return replace(self, camera=self.camera.framing(points, 1.2 * MODE_REACH))

    def pixels(
        self, shape: FloatArray, size: int, colours: Any = CLAY, faces: IntArray | None = None, *, smooth: bool = True
    ) -> NDArray[np.uint8]:
        """Draw a shape (V, 3), or several shapes (T, V, 3) side by side.

        The longer side of one shape's picture has ``size`` pixels. Colours are a name, or sRGB (…, V, 3) between 0 and
        1. Returns (height, width, 4) sRGB and coverage. See `Camera.render`.
        """
        faces = self.faces if faces is None else faces
        shapes = shape.reshape(-1, *shape.shape[-2:])
        tints = np.broadcast_to(to_rgb(colours) if isinstance(colours, str) else colours, shapes.shape)
        pictures = [self.camera.render(x, faces, c, size, smooth=smooth) for x, c in zip(shapes, tints, strict=True)]
        return np.concatenate(pictures, axis=1)

    def draw(self, shape: FloatArray, alt: str, size: int, *how: Any, **more: Any) -> Markup:
        """Return the picture from `pixels` as an HTML element with alternative text."""
        pixels = self.pixels(shape, size, *how, **more)
        file = io.BytesIO()
        Image.fromarray(pixels).save(file, format="WEBP", quality=84)
        height, width = pixels.shape[:2]
        return Markup('<img src="data:image/webp;base64,{}" width="{}" height="{}" alt="{}">').format(
            base64.b64encode(file.getvalue()).decode(), width, height, alt
        )


def ramp(hue: str) -> Colormap:
    """Return colours from clay to a hue.

    The middle has more of the hue than linear interpolation gives, which would look muddy.
    """
    middle = 0.35 * np.array(to_rgb(CLAY)) + 0.65 * np.array(to_rgb(hue))
    return LinearSegmentedColormap.from_list(hue, [to_rgb(CLAY), tuple(middle), to_rgb(hue)])


def tint(colours: Colormap, values: FloatArray) -> FloatArray:
    """Return colours (…, 3) for values between 0 and 1."""
    return np.asarray(colours(np.nan_to_num(values).clip(0, 1)))[..., :3]


def colour_bar(colours: Colormap, *labels: str) -> dict[str, Any]:
    """Return a legend: a CSS gradient, and evenly spaced labels."""
    stops = ", ".join(to_hex(colours(x)) for x in np.linspace(0, 1, 9))
    return {"gradient": f"linear-gradient(90deg, {stops})", "labels": labels}
