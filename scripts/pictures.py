"""Write the pictures of the README and of the tutorials from the bundled figure: ``python -m scripts.pictures``.

The moving picture follows a closed path of codes. Each small picture explains one word: exponential, factor, remember.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.interpolate import CubicSpline

import shapespace
from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import align
from shapespace.training.report.pictures import CLAY, Studio, ramp, tint
from shapespace.training.report.rendering import Camera

DOCS = Path("docs")
#: Colour of what moves, as on the page and in reports.
BLUE = "#1f6f8b"
#: Seeds of the poses on the path, frames from one pose to the next, milliseconds of a frame, pixels of the figure.
SEEDS, FRAMES, DURATION, SIZE = (3, 8, 14, 21, 5), 12, 70, 420
#: Pixels from the left edge to the right end of the sliders, and of the space beside them.
SLIDERS, SPACE = 150, 24
#: Resolution of the small pictures.
DPI = 110


def moving(model: shapespace.ShapeModel, path: Path) -> None:
    """Draw the figure beside its sliders while its code moves along a closed path."""
    keys = np.concatenate([model.sample(1, seed, "population", temperature=1.2) for seed in SEEDS])
    keys = np.clip(keys, model.lower, model.upper)
    spline = CubicSpline(np.arange(len(keys) + 1), np.concatenate([keys, keys[:1]]), bc_type="periodic")
    codes = spline(np.arange(len(keys) * FRAMES) / FRAMES).clip(model.lower, model.upper)
    shapes = model.decode(codes)
    studio = studio_of(model, shapes)
    pictures = []
    for code, shape in zip(codes, shapes, strict=True):
        figure = flat(studio.pixels(shape, SIZE))
        height, width = figure.shape[:2]
        picture = Image.new("RGB", (width + SLIDERS + SPACE, height), "white")
        picture.paste(Image.fromarray(figure), (SLIDERS + SPACE, 0))
        draw_sliders(ImageDraw.Draw(picture), (code - model.lower) / (model.upper - model.lower), height)
        pictures.append(picture)
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=DURATION, loop=0, quality=68, method=6)


def draw_sliders(draw: ImageDraw.ImageDraw, values: FloatArray, height: int) -> None:
    """Draw a slider for each value between 0 and 1, from top to bottom."""
    for k, value in enumerate(values):
        y = height * (k + 1) / (len(values) + 1)
        x = SPACE + value * (SLIDERS - SPACE)
        draw.line([(SPACE, y), (SLIDERS, y)], fill="#c9c4bb", width=3)
        draw.ellipse([x - 6, y - 6, x + 6, y + 6], fill=BLUE)


def studio_of(model: shapespace.ShapeModel, shapes: FloatArray, faces: NDArray | None = None) -> Studio:
    """Return the reports' camera, turned so that it holds all shapes (n, V, 3)."""
    faces = model.faces if faces is None else faces
    base = shapes[0]
    return Studio(Camera.facing(base, faces, shapes), base, faces)


def flat(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a picture on white instead of a transparent background."""
    cover = picture[..., 3:] / 255
    return (picture[..., :3] * cover + 255 * (1 - cover)).astype(np.uint8)


def exponential(model: shapespace.ShapeModel, path: Path) -> None:
    """Draw shapes on the geodesic from the mean to a pose, with the two maps between its ends."""
    space = shapespace.ShellSpace(model.reference)
    code = np.zeros(model.dimension)
    code[[0, 2, 6, 9]] = model.upper[[0, 2, 6, 9]]
    start, end = model.decode(np.stack([np.zeros_like(code), code]), mesh="coarse") / model.manifest.scale
    found = align(shapespace.geodesic(space, start, end, 4).vertices, start)
    studio = studio_of(model, found, model.reference.faces)
    row, axes = strip([studio.pixels(shape, 260, CLAY if k in (0, 4) else "#ece8e1") for k, shape in enumerate(found)])
    axes[0].set_title("mean", fontsize="medium")
    axes[-1].set_title("another shape", fontsize="medium")
    arrow(row, (0.14, 0.97), (0.84, 0.97), "exponential: a start direction gives the shape")
    arrow(row, (0.84, 0.05), (0.14, 0.05), "logarithm: the shape gives the start direction")
    finish(row, path)


def arrow(figure: Figure, start: tuple[float, float], end: tuple[float, float], words: str) -> None:
    """Draw an arrow between two points of the figure, with words in its middle."""
    style = {"arrowstyle": "->", "color": BLUE, "lw": 1.5}
    figure.axes[0].annotate("", end, start, "figure fraction", "figure fraction", arrowprops=style)
    middle = ((start[0] + end[0]) / 2, start[1])
    box = {"facecolor": "white", "edgecolor": "none", "pad": 3}
    figure.text(*middle, words, ha="center", va="center", color=BLUE, fontsize="medium", bbox=box)


def factor(model: shapespace.ShapeModel, path: Path) -> None:
    """Draw what some factors move: each at one end of its coordinates, coloured by displacement."""
    chosen = [
        factor for factor in model.manifest.factors if factor.name in ("right knee", "right shoulder", "left elbow")
    ]
    codes = np.zeros((len(chosen) + 1, model.dimension))
    for code, factor in zip(codes[1:], chosen, strict=True):
        code[factor.start : factor.stop] = model.upper[factor.start : factor.stop]
    shapes = model.decode(codes)
    moved = np.linalg.norm(shapes - shapes[0], axis=2)
    studio = studio_of(model, shapes)
    colours = tint(ramp(BLUE), moved / moved.max(axis=1, keepdims=True).clip(1e-9))
    row, axes = strip([studio.pixels(x, 300, c) for x, c in zip(shapes, colours, strict=True)])
    for axis, words in zip(axes, ["all sliders at 0", *(factor.name for factor in chosen)], strict=True):
        axis.set_title(words, fontsize="medium")
    finish(row, path)


def remember(path: Path) -> None:
    """Draw a model of one number with one output, without and with the shapes that it remembers."""
    x = np.linspace(0, 1, 400)
    codes = np.array([0.12, 0.33, 0.58, 0.85])
    true = np.sin(2.2 * codes) + np.array([0.08, -0.07, 0.07, -0.06])
    missed = true - np.sin(2.2 * codes)
    bumps = np.exp(-0.5 * ((x[:, None] - codes) / 0.06) ** 2)
    figure, axes = plt.subplots(figsize=(5.2, 2.4), layout="constrained")
    axes.plot(x, np.sin(2.2 * x), "--", color="#8d877c", label="networks alone")
    axes.plot(x, np.sin(2.2 * x) + bumps @ missed, color=BLUE, label="with remembered shapes")
    axes.plot(codes, true, "o", color="#e4572e", label="training shapes")
    axes.set(xlabel="code", ylabel="shape", xticks=[], yticks=[])
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize="small")
    finish(figure, path)


def strip(pictures: list[NDArray[np.uint8]]) -> tuple[Figure, list[Axes]]:
    """Return a figure with pictures side by side, and their axes."""
    height, width = pictures[0].shape[:2]
    size = (len(pictures) * width / DPI, height / DPI + 0.9)
    figure, grid = plt.subplots(1, len(pictures), figsize=size, squeeze=False)
    figure.subplots_adjust(0, 0.1, 1, 0.84, 0, 0)
    for axis, picture in zip(grid[0], pictures, strict=True):
        axis.imshow(flat(picture))
        axis.set_axis_off()
    return figure, list(grid[0])


def finish(figure: Figure, path: Path) -> None:
    """Save a figure with few colours, which makes small files."""
    figure.savefig(path, dpi=DPI, facecolor="white", bbox_inches="tight")
    plt.close(figure)
    Image.open(path).convert("RGB").quantize(128).save(path, optimize=True)


def main() -> None:
    """Write all pictures."""
    model = shapespace.load("models/figure")
    moving(model, DOCS / "figure.webp")
    exponential(model, DOCS / "tutorial" / "exponential.png")
    factor(model, DOCS / "tutorial" / "factor.png")
    remember(DOCS / "tutorial" / "remember.png")


if __name__ == "__main__":
    main()
