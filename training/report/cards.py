"""Cards of a run's report: pictures of shapes, with the figures that belong to them."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.colors import to_rgb

from shapespace.counted import counted
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import diagonal
from shapespace.training.report.number_format import percent
from shapespace.training.report.pictures import (
    CLAY,
    COMPOSITE,
    ERROR,
    MODE_REACH,
    NEUTRAL,
    Studio,
    colour_bar,
    ramp,
    tint,
)
from shapespace.training.report.record import HUES, Record
from shapespace.training.runs.atomic_files import NpzFile

#: Pixels of a picture's longer side. Pages show pictures at half that size or less, so that phones show them sharply.
LARGE, SMALL = 480, 300
#: Simple models beside ours, by their names in generalisation.json.
SIMPLE = {
    "modes": "model",
    "components": "PCA",
    "mirrored_components": "PCA with mirror images",
    "remembering_components": "PCA with memory of the training shapes",
    "linear_nric": "straight lines of lengths and angles",
    "differential_coordinates": "straight lines of rotations and stretches",
}
#: The maps from codes to shapes, in words.
MAPS = {
    "vertices": "straight lines of vertices",
    "nric": SIMPLE["linear_nric"],
    "differential": SIMPLE["differential_coordinates"],
    "exponential": "exponentials",
}
#: Largest number of modes with pictures.
MODES_SHOWN = 40


def shape_pictures(record: Record, studio: Studio) -> Iterator[tuple[Markup, str]]:
    """Draw the mean and the reference, which may have two resolutions, each with a caption."""
    reference, faces = record.reference["vertices"], record.reference["faces"]
    if record.mean is not None:
        yield studio.draw(studio.base, "The mean shape", LARGE), "mean of your shapes"
    aligned = align(reference, studio.base)
    if "fine_vertices" in record.reference:
        # The motion of the coarse reference, found as an affine map, also moves the fine reference.
        motion = np.linalg.lstsq(np.c_[reference, np.ones(len(reference))], aligned)[0]
        fine, fine_faces = record.reference["fine_vertices"], record.reference["fine_faces"]
        moved = np.c_[fine, np.ones(len(fine))] @ motion
        picture = studio.draw(moved, "The reference mesh", LARGE, faces=fine_faces)
        yield picture, f"fine reference mesh, {len(fine):,} vertices"
    elif record.mean is None:
        yield studio.draw(aligned, "The reference mesh", LARGE), "reference"
    picture = studio.draw(aligned, "The reference mesh, its triangles visible", LARGE, smooth=False)
    yield picture, f"coarse reference mesh, {len(reference):,} vertices and {len(faces):,} faces"


def mode_cards(record: Record, studio: Studio) -> Iterator[dict[str, Any]]:
    """Draw each SPGA mode beside the PGA mode of the same index: the mean moved along it, coloured by its support. The
    modes of straight lines stand alone.
    """
    modes = record.modes
    factor_of = {i: factor for factor in record.factors for i in factor.modes}
    own = record.mode_kind
    kinds = [(kind, prefix) for kind, prefix in ((own, ""), ("PGA", "pga_")) if f"{prefix}vertices" in modes]
    support = {kind: record.supports(modes[f"{prefix}nric"]) for kind, prefix in kinds}
    reach = MODE_REACH * diagonal(studio.base)
    for i in range(min(len(modes["vertices"]), MODES_SHOWN)):
        title, factor = f"Mode {i}", factor_of.get(i)
        pictures = []
        for kind, prefix in kinds:
            if i < len(support[kind]):
                field = modes[f"{prefix}vertices"][i]
                moved = studio.base + reach / np.linalg.norm(field, axis=1).max().clip(1e-300) * field
                colours = tint(ramp(factor.hue if factor and kind == own else NEUTRAL), support[kind][i])
                local = modes.get(f"{prefix}localisation")
                caption = kind if local is None else f"{kind} · {local[i]:.2f}"
                alt = f"{title} of {kind}, coloured where it changes the shape"
                pictures.append((studio.draw(moved, alt, SMALL, colours), caption))
        yield {"title": title, "factor": factor, "pictures": pictures}


def factor_cards(record: Record, studio: Studio | None) -> Iterator[dict[str, Any]]:
    """Draw all factors in one picture, then each factor by the support of its modes."""
    pictures: list[Markup | None] = [None] * len(record.factors)
    if studio and "nric" in record.modes and record.factors:
        each = record.supports(record.modes["nric"])
        support = np.array([each[factor.modes].max(axis=0, initial=0) for factor in record.factors])
        for j, factor in enumerate(record.factors):
            colours = tint(ramp(factor.hue), support[j])
            pictures[j] = studio.draw(studio.base, f"Where {factor.name} changes the shape", SMALL, colours)
        share, strength = support**4 / (support**4).sum(axis=0).clip(1e-300), support.max(axis=0)[:, None]
        mixed = share.T @ np.array([to_rgb(factor.hue) for factor in record.factors])
        colours = (1 - strength) * to_rgb(CLAY) + strength * mixed
        yield {"factor": None, "picture": studio.draw(studio.base, "All factors, each in its colour", SMALL, colours)}
    for factor, picture in zip(record.factors, pictures, strict=True):
        yield {"factor": factor, "picture": picture}


def extreme_shapes(record: Record, studio: Studio) -> dict[str, Any] | None:
    """Draw the best, the median and the worst shape of the test split.

    Colours show errors on one logarithmic scale of two decades.
    """
    gallery = record.gallery
    if not {"test_exact", "test_predicted", "test_error"} <= gallery.keys():
        return None
    error = gallery["test_error"]
    top = max(float(error.max()), 1e-12)
    rows = []
    for k, title in enumerate(("Best", "Median", "Worst")[: len(error)]):
        exact = align(gallery["test_exact"][k], studio.base)
        colours = tint(ERROR, 1 + np.log10(error[k].clip(1e-300) / top) / 2)
        predicted = align(gallery["test_predicted"][k], exact)
        alt = f"{title} test shape of the network, coloured by its error"
        rows.append({
            "title": title,
            "number": int(gallery["test_index"][k]) if "test_index" in gallery else None,
            "exact": studio.draw(exact, f"{title} test shape, exact", LARGE),
            "predicted": studio.draw(predicted, alt, LARGE, colours),
            "mean": float(error[k].mean()),
            "max": float(error[k].max()),
        })  # fmt: skip
    return {"rows": rows, "bar": colour_bar(ERROR, *(percent(top * x) for x in (0.01, 0.1, 1)))}


def random_shapes(record: Record, studio: Studio) -> list[Markup]:
    """Draw shapes of random codes, which the networks made."""
    shapes = record.gallery.get("random", ())
    return [
        studio.draw(align(shape, studio.base), f"Random shape {k}", SMALL, COMPOSITE)
        for k, shape in enumerate(shapes, 1)
    ]


def accuracy_cards(record: Record, studio: Studio | None) -> list[dict[str, Any]]:
    """Compare the user's shapes, held-out and learned ones, with the nearest shapes of the space.

    Each card has distances beside the distances by principal components, and a picture of its worst shape.
    """
    cards = []
    if (facts := record.generalisation) and "failed" not in facts:
        how = (
            f"{counted(facts['held_out'], 'shape')}, left out when map, mean and modes were chosen"
            f"{', with all shapes related to them' if 'groups' in facts else ''}. Measured with exact shapes instead "
            "of networks"
        )
        if facts.get("stuck"):
            how += f". The search for {counted(facts['stuck'], 'shape')} failed because faces collapse"
        cards.append({
            "title": "Unseen shapes",
            "how": how,
            "figures": [
                (coordinates(count), of, components)
                for count, of, components in zip(facts["counts"], facts["modes"], facts["components"], strict=True)
            ]
            + _converged(facts),
            "simple": [
                (title, [each["mean"] for each in facts[name]]) for name, title in SIMPLE.items() if name in facts
            ],
            "worst": facts["worst"],
            "pictures": _pair(record.run.least_general, facts["worst"], studio),
        })  # fmt: skip
    if facts := record.encoded:
        modes = facts.get("modes")
        cards.append({
            "title": "Training shapes",
            "how": f"all {facts['shapes']} shapes, encoded as the server does it, on the "
            f"{facts.get('mesh', 'coarse')} mesh"
            + (". The bundle stores corrections at these shapes" if facts.get("remembered") else ""),
            "figures": [
                ("as served", facts, facts["components"]),
                *([("modes alone, no networks, coarse mesh", modes, facts["components"])] if modes else []),
            ],
            "worst": facts["worst"],
            "pictures": _pair(record.run.least_near, facts["worst"], studio),
        })  # fmt: skip
    return cards


def coordinates(count: float) -> str:
    """Return a number of coordinates in words; a mean over folds may be no whole number."""
    return counted(int(count) if count == int(count) else round(count, 1), "coordinate")


def _converged(facts: dict[str, Any]) -> list[tuple[str, dict[str, float], dict[str, float]]]:
    """Return a row for the held-out shapes whose search converged, if it didn't for all."""
    if not facts.get("stuck") or not facts["not_stuck"]:
        return []
    some, count = facts["not_stuck"], facts["held_out"] - facts["stuck"]
    return [(f"searches that ended ({count})", some["modes"], some["components"])]


def _pair(file: NpzFile, title: str, studio: Studio | None) -> list[tuple[Markup, str]]:
    """Draw a given shape and the shape found for it, if the file has them."""
    shapes = file.read_if_written() if studio else {}
    return [
        (studio.draw(align(shapes[name], studio.base), f"{title}, {name}", LARGE), name)
        for name in ("given", "found")
        if studio and name in shapes
    ]


def interpolation_strips(record: Record, studio: Studio) -> Iterator[tuple[str, str, Markup]]:
    """Draw an interpolation: the joint shapes, and below them each factor's own element (paper, figure of SCAPE).

    Yields:
        A title, a colour, and the frames side by side.
    """
    gallery = record.gallery
    if "strip_joint" in gallery:
        joint = align(gallery["strip_joint"], studio.base)
        yield "Together", COMPOSITE, studio.draw(joint, "The interpolation, frame by frame", SMALL, COMPOSITE)
    for j, frames in enumerate(gallery.get("strip_factors", ())):
        name, hue = f"Factor {j}", HUES[j % len(HUES)]
        if j < len(record.factors):
            name, hue = record.factors[j].name, record.factors[j].hue
        frames = align(frames, studio.base)
        moved = np.linalg.norm(frames - studio.base, axis=-1)
        colours = tint(ramp(hue), moved / max(float(moved.max()), 1e-300))
        yield name, hue, studio.draw(frames, f"{name} alone, frame by frame", SMALL, colours)
