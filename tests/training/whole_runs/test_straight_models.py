"""Runs of straight-line models: nothing is trained, and the bundle is served like any other."""

import json
from pathlib import Path

import numpy as np
import pytest

import shapespace
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.report.page import write_report
from shapespace.training.runs.config import parse
from shapespace.training.stages.generalisation import measure_generalisation
from shapespace.training.stages.run import execute
from shapespace.training.stages.stage import Run
from tests.training.conftest import bent

CONFIG = """
[collection]
data = {data}
mirror = false

[modes]
geometry = "{geometry}"
count = {count}

[factors]
count = 2

[evaluation]
baselines = true
reconstructions = 2

[export]
decoder = {decoder}
name = "straight"
title = "Straight"
description = "A run for the tests."
licence = "MIT"
examples = {examples}
"""


@pytest.mark.parametrize(
    ("geometry", "examples"),
    [pytest.param("vertices", False, marks=pytest.mark.long), ("nric", True), ("differential", False)],
)
def test_a_straight_line_model_is_served_without_training(
    blends: tuple[TriangleMesh, np.ndarray], ellipsoid: TriangleMesh, tmp_path: Path, geometry: str, examples: bool
) -> None:
    mesh, shapes = blends if geometry == "vertices" else (ellipsoid, bent(ellipsoid, np.linspace(-1, 1, 6)))
    data = tmp_path / "shapes.npz"
    np.savez(data, vertices=shapes, faces=mesh.faces)
    decoder = not examples  # one of both, because PyTorch takes long to export it
    flags = {name: str(flag).lower() for name, flag in (("examples", examples), ("decoder", decoder))}
    text = CONFIG.format(data=json.dumps(str(data)), geometry=geometry, count=2, **flags)
    run = Run(tmp_path / "run", parse(text, "straight.toml"), text, tmp_path / "models")
    said: list[str] = []
    assert execute(run, show=said.append)
    assert not run.directory.networks()
    assert any("factors.count, evaluation.baselines have no effect" in sentence for sentence in said)
    lines, scale = run.collection.lines, run.collection.scale
    model = shapespace.load(run.bundle)
    assert [factor.name for factor in model.manifest.factors] == ["whole shape"]
    assert (model.manifest.decoder is not None) == decoder
    assert model.manifest.exponential_steps == (1 if geometry == "vertices" else None)
    size = np.ptp(model.decode(np.zeros(2)), axis=0).max()
    if examples:
        report = write_report(run.directory).read_text(encoding="utf-8")
        assert "Straight lines learn no networks" in report
        assert "R²" not in report
        assert "SPGA" not in report
        # Memory brings training shapes back that two straight lines do not have.
        found = [model.decode(code) for code in run.collection.codes]
        errors = [np.abs(align(shape, near) - near).max() / size for shape, near in zip(shapes, found, strict=True)]
        assert max(errors) < 2e-3
    else:
        assert model.decoder.auto is not None
        assert model.decoder.auto.tolerance is None, "lines need no Gauss–Newton"
        for code in (np.array([0.5, -0.7]), lines.coefficients[0], 1.2 * run.collection.upper):
            served = model.decode(code)
            expected = align(scale * lines.shape(code)[0], served)
            assert np.abs(served - expected).max() < 1e-4 * size
        # Straight lines are as exact far outside the bounds as inside, so the search goes there.
        far = run.collection.upper + 3.6 * np.array([0, run.collection.upper[1] - run.collection.lower[1]])
        assert model.encode(model.decode(far)).distances.max() < 1e-3 * size
    code = 0.3 * run.collection.upper
    step = 1e-3 * np.eye(2)[0]
    slope = (align(model.decode(code + step), model.decode(code - step)) - model.decode(code - step)) / 2e-3
    assert np.abs(model.jacobian(code)[..., 0] - slope).max() < 0.05 * np.abs(slope).max()
    figures = run.directory.evaluation.read()
    assert figures["r2"]["composite"]["total"] > (0.999 if geometry == "vertices" else 0.99)
    assert {"components", "remembering_components", "linear_nric"} <= figures["generalisation"].keys()
    assert run.directory.geometry.read()["kind"] == geometry
    assert not execute(run, show=said.append), "nothing is left to do"
    report = _report(run)
    assert "Codes make shapes by straight lines of " in report
    assert "PCA with memory" in report


def test_unseen_shapes_do_not_try_maps_that_were_clearly_worse_on_all_shapes(
    ellipsoid: TriangleMesh, tmp_path: Path
) -> None:
    data = tmp_path / "shapes.npz"
    np.savez(data, vertices=bent(ellipsoid, np.linspace(-1, 1, 6)), faces=ellipsoid.faces)
    text = CONFIG.format(data=json.dumps(str(data)), geometry="auto", count=2, examples="false", decoder="false")
    run = Run(tmp_path / "run", parse(text, "straight.toml"), text, tmp_path / "models")
    execute(run, "mean")
    chosen = run.directory.geometry.read()
    assert chosen["kind"] != "nric"
    worse = {kind: 2 * chosen["errors"]["nric"] for kind in chosen["errors"] if kind != "nric"}
    run.directory.geometry.write(chosen | {"kind": "nric", "errors": chosen["errors"] | worse})
    measure_generalisation(run)
    assert run.directory.generalisation.read()["maps"] == ["nric"]


def test_related_shapes_are_left_out_together(ellipsoid: TriangleMesh, tmp_path: Path) -> None:
    """Each bend comes in three scans that differ a little. Alone, a left-out scan would be known already."""
    rng = np.random.default_rng(0)
    scans = np.repeat(bent(ellipsoid, np.linspace(-1, 1, 5)), 3, axis=0)
    scans += 0.1 * rng.normal(size=(5, 1, *ellipsoid.vertices.shape)).repeat(3, axis=1).reshape(scans.shape)
    scans += 0.001 * rng.normal(size=scans.shape)
    names = [f"sub-{k // 3} scan {k % 3}" for k in range(15)]
    data = tmp_path / "shapes.npz"
    np.savez(data, vertices=scans, faces=ellipsoid.faces, names=names)
    text = CONFIG.format(data=json.dumps(str(data)), geometry="vertices", count=4, examples="true", decoder="false")
    errors = {}
    for name, related in {"alone": "", "together": "related = 'sub-[0-9]+'\n"}.items():
        given = text.replace("mirror = false\n", f"mirror = false\n{related}")
        run = Run(tmp_path / name, parse(given, "straight.toml"), given, tmp_path / "models")
        said: list[str] = []
        assert execute(run, show=said.append)
        errors[name] = run.directory.generalisation.read()["modes"][-1]["mean"]
        assert any("5 groups of related shapes" in sentence for sentence in said) == bool(related)
        assert ("with all shapes related to them" in _report(run)) == bool(related)
    assert errors["together"] > 5 * errors["alone"]


def test_a_run_says_that_there_are_fewer_modes_than_asked_for(
    blends: tuple[TriangleMesh, np.ndarray], tmp_path: Path
) -> None:
    data = tmp_path / "shapes.npz"
    np.savez(data, vertices=blends[1], faces=blends[0].faces)
    text = CONFIG.format(data=json.dumps(str(data)), geometry="vertices", count=99, examples="false", decoder="false")
    said: list[str] = []
    execute(Run(tmp_path / "run", parse(text, "straight.toml"), text, tmp_path / "models"), "modes", show=said.append)
    assert any("of 99 modes, because" in sentence for sentence in said)


def _report(run: Run) -> str:
    from shapespace.training.report.page import write_report

    return write_report(run.directory).read_text()
