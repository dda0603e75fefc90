"""Run the command on a folder, and check messages, exit code and the shapes of the bundle."""

import io
import re
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

import numpy as np

from shapespace.bundle.reader import read_bundle
from shapespace.mesh.triangle_mesh import Connectivity, diagonal, face_normals
from shapespace.mesh.triangle_quality import FOLD_LIMIT
from shapespace.mesh.vectors import dots
from shapespace.model.correspondence import Matched
from shapespace.model.decoder import MeshChoice
from shapespace.model.shape_model import ShapeModel
from shapespace.training import __main__ as training
from shapespace.training.collection.ingest import read_collection
from tests.folders.catalogue import Folder
from tests.training.conftest import small_config

#: Largest numbers of codes to compute shapes of, and of training shapes to encode.
CODES, ENCODED = 100, 10


def command(arguments: Sequence[str]) -> tuple[int, str]:
    """Exit code and output of ``shapespace-train``, run in this process, as importing torch takes long."""
    words = io.StringIO()
    with patch("sys.argv", ["shapespace-train", *arguments]), redirect_stdout(words), redirect_stderr(words):
        return training.main(), words.getvalue()


def hold(folder: Folder, place: Path) -> str:
    """Build a folder, run the command on it, check the outcome and return it in a few words.

    Raises:
        AssertionError: the outcome isn't the expected one.
    """
    meshes = place / "meshes"
    folder.build(meshes)
    data = meshes if meshes.exists() else meshes.with_suffix(".npz")
    code, first = command(["init", str(data), "--out", str(place / "init.toml")])
    assert code in (0, 1), first
    assert "Traceback" not in first, first
    config = place / "figure.toml"
    text = small_config(
        "figure",
        data.name,
        vertices=250,
        modes=4,
        log_steps=4,
        samples=80,
        part_size=20,
        epochs=10,
        correction='kind = "kernel", coefficients = 6',
        evaluation="reconstructions = 4\nexact_factors = 4",
        skip_degree=3,
    )
    config.write_text(text.replace("[factors]", "max_iterations = 40\n\n[factors]", 1), encoding="utf-8")
    run = ["run", str(config), "--out", str(place / "run"), "--models", str(place / "models"), *folder.arguments]
    if folder.later:
        code, words = command([*run, "--until", "ingest"])
        assert code == 0, words
        folder.later(meshes)
    code, words = command(run)
    assert "Traceback" not in words, words
    assert code in folder.codes, f"exit code {code}: {words}"
    assert re.search(folder.says, words), words
    if folder.quick:
        assert len(words) < 1000, words
        assert not (place / "models").exists()
    if code:
        return f"code {code}: {words.strip().splitlines()[-1][:100]}"
    # A shape with crossed faces, accepted with --accept, may fold served shapes if the run says so.
    insists = "--accept" in folder.arguments and "where no training shape has a crease" in words
    return sound(folder, place, data, may_fold=insists)


def sound(folder: Folder, place: Path, data: Path, *, may_fold: bool) -> str:
    """Check shapes that the bundle decodes and training shapes that it encodes; return errors in words."""
    model = ShapeModel(read_bundle(place / "models" / "figure" / "1"))
    faces = Connectivity(model.reference.faces, len(model.reference.vertices))
    left, right = faces.edge_faces[faces.interior].T

    def bends(shape: np.ndarray) -> np.ndarray:
        """Cosines of the angles between normals of neighbouring faces."""
        normals = face_normals(shape, faces.faces)
        return dots(normals[left], normals[right])

    with np.load(place / "run" / "shapes.npz") as file:
        # Served shapes may be folded only where a shape of the collection has a crease.
        crease = np.min([bends(shape) for shape in file["vertices"]], axis=0) < 0
    codes = np.random.default_rng(0).uniform(
        model.latents.lower, model.latents.upper, (CODES, len(model.latents.lower))
    )
    served = [model.shape(code.astype(np.float32), mesh=MeshChoice.COARSE) for code in codes]
    stalled = [shape.diagnostics.status for shape in served if shape.diagnostics.status != "converged"]
    assert not stalled, f"{len(stalled)} of {CODES} served codes end otherwise than converged: {set(stalled)}"
    folds = sum(int(((bends(shape.vertices) < FOLD_LIMIT) & ~crease).sum()) for shape in served)
    assert may_fold or not folds, (
        f"{folds} edges of {CODES} served shapes are folded where the collection has no crease"
    )
    flipped = sum(shape.diagnostics.flipped_faces for shape in served)
    assert may_fold or not flipped, f"{flipped} faces of {CODES} served shapes are flipped"

    collection = read_collection(data)
    errors = []
    for name, shape in list(zip(collection.names, collection.vertices, strict=True))[:ENCODED]:
        if name not in folder.odd:
            found = model.encode(Matched(np.array(shape), MeshChoice.FINE))
            errors.append(found.distances.mean() / diagonal(shape))
    assert np.mean(errors) <= folder.back, f"training shapes come back to {np.mean(errors):.3f} of the diagonal"
    centre = collection.vertices[collection.central]
    away = np.linalg.norm((model.decoder.reference_shape().vertices - centre).mean(axis=0)) / diagonal(centre)
    assert away < 0.02, f"the reference is served {away:.3f} of the diagonal from where its file has it"
    return f"bundle: {CODES} codes without a fold, shapes to {100 * np.mean(errors):.2f} %"
