"""Compiled loops beside the NumPy code that says what they compute."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import shapespace
from shapespace.coordinates import compiled
from shapespace.coordinates.frame_integration import CompiledFrameIntegration, FrameIntegration
from shapespace.coordinates.integrability import Integrability
from shapespace.coordinates.least_squares import CompiledLeastSquares, LeastSquares
from shapespace.coordinates.normal_matrix import NormalMatrix
from shapespace.coordinates.nric import WeightedNorm, nric

# Without Numba the loops are plain Python: the same numbers, slowly.


@pytest.fixture
def asked(mesh, pose, rng):
    """Lengths and angles of no shape, some angles more than half a turn away."""
    z = nric(pose, mesh.connectivity)
    z *= 1 + 0.02 * rng.standard_normal(len(z))
    z[-20:] += 2 * np.pi * mesh.connectivity.interior[-20:]
    return z


def test_misfits_forces_and_normal_matrices_are_the_same(mesh, asked):
    norm, matrix = WeightedNorm.of(mesh, 1e-2), NormalMatrix(mesh.connectivity)
    one, other = (
        squares(mesh.connectivity, norm, matrix)(mesh.vertices, asked)
        for squares in (LeastSquares, CompiledLeastSquares)
    )
    np.testing.assert_allclose(other.misfit, one.misfit, rtol=0, atol=1e-12)
    assert other.energy == pytest.approx(one.energy, rel=1e-12)
    np.testing.assert_allclose(other.forces(), one.forces(), rtol=0, atol=1e-11 * np.abs(one.forces()).max())
    np.testing.assert_allclose(other.entries(), one.entries(), rtol=0, atol=1e-12 * np.abs(one.entries()).max())


def test_frames_are_the_same(mesh, asked):
    one, other = FrameIntegration(mesh)(asked), CompiledFrameIntegration(mesh)(asked)
    # The Poisson equation is anchored by a billionth only.
    np.testing.assert_allclose(other, one, rtol=0, atol=1e-6 * mesh.diagonal)


def test_closing_conditions_are_the_same(mesh, asked):
    one, other = (Integrability(mesh.connectivity, kernels).at_vertices(asked) for kernels in ("numpy", "compiled"))
    np.testing.assert_allclose(other, one, rtol=0, atol=1e-12)


@np.errstate(invalid="ignore")
def test_lengths_of_nothing_or_without_end_are_not_finite_and_raise_nothing(mesh, asked):
    squares = CompiledLeastSquares(mesh.connectivity, WeightedNorm.of(mesh, 1e-2), NormalMatrix(mesh.connectivity))
    assert not np.isfinite(squares(mesh.vertices, np.full_like(asked, np.inf)).energy)
    flat = squares(0 * mesh.vertices, asked)
    assert not np.isfinite(flat.forces()).all()
    assert not np.isfinite(flat.entries()).all()


def test_the_choice_is_made_by_what_is_installed():
    assert compiled.are_used("auto") is compiled.AVAILABLE
    assert compiled.are_used("compiled")
    assert not compiled.are_used("numpy")


@pytest.mark.skipif(not compiled.AVAILABLE, reason="Numba is an extra: `make compiled` runs this")
def test_machine_code_is_found_where_nothing_can_be_written(tmp_path, monkeypatch):
    """As in an image: made once beside the package, and found by processes that can write no file."""
    shutil.copytree(Path(shapespace.__path__[0]), tmp_path / "shapespace", ignore=shutil.ignore_patterns("__pycache__"))
    script = "import shapespace.coordinates.compiled as c; print(c.__file__, sum(c.misfit.stats.cache_hits.values()))"
    nowhere = "import tempfile\ndef f(*_, **__): raise OSError('read-only')\ntempfile.TemporaryFile = f\n"
    monkeypatch.setenv("NUMBA_CACHE_LOCATOR_CLASSES", "shapespace.coordinates.compiled.BesideTheModule")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    for prefix, hits in (("", 0), (nowhere, 1)):
        called = subprocess.run(
            [sys.executable, "-c", prefix + script], cwd=tmp_path, capture_output=True, text=True, check=True
        )
        file, found = called.stdout.split()
        assert Path(file).is_relative_to(tmp_path)
        assert int(found) == hits
