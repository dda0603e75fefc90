"""The real command on a small torus: its files, which stages it repeats, and what a kill costs."""

import hashlib
import json
import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

import shapespace
from benchmarks.studies import ShareLearner
from shapespace.bundle.reader import read_bundle
from shapespace.coordinates.nric import WeightedNorm, nric
from shapespace.model.accuracy import measure_accuracy
from shapespace.model.shape_model import ShapeModel
from shapespace.training.collection.generators.freaky_torus import FreakyTorus, vertices
from shapespace.training.learning.evaluation import r_squared
from shapespace.training.learning.fitting import read_network
from shapespace.training.runs.config import load
from shapespace.training.runs.sampling import read
from shapespace.training.stages.networks import learner_of
from shapespace.training.stages.stage import Run
from tests.training.conftest import TINY, command

pytestmark = pytest.mark.long


def test_a_run_leaves_what_the_contract_promises(tiny_run: Path) -> None:
    with np.load(tiny_run / "reference.npz") as reference:
        assert reference["vertices"].shape == (2048, 3)
        assert reference["faces"].shape == (4096, 3)
        assert reference["edges"].shape == (6144, 2)
        scale = float(reference["scale"])
        np.testing.assert_allclose(scale * reference["vertices"], vertices(np.zeros((1, 4)))[0], atol=1e-12)
    factors = json.loads((tiny_run / "factors.json").read_text())
    assert factors["factors"] == [[0], [1], [2, 3]]
    with np.load(tiny_run / "samples" / "part-00001.npz") as part:
        assert part["index"].tolist() == list(range(20, 40))
        np.testing.assert_allclose(scale * part["vertices"], vertices(part["latents"]), atol=1e-6)
        assert set(part["status"]) == {"done"}
        assert part["nric"].shape == (20, 2 * 6144)
    figures = json.loads((tiny_run / "evaluation.json").read_text())
    assert 0.9 < figures["r2"]["affine"]["total"] < 0.99
    assert figures["r2"]["composite"]["total"] > 0.5
    assert not figures.keys() & {"variants", "validation", "fractions", "seeds"}, "figures of studies"
    assert figures["vertex_error"]["max"] > figures["vertex_error"]["mean"] > 0


def test_no_factor_learns_from_parts_of_test_codes(tiny_run: Path) -> None:
    run = Run(tiny_run, *load(tiny_run / "config.toml"), tiny_run / "models")
    learner = learner_of(run)
    half, free = (ShareLearner(learner, 0.5, all_of_factors=every) for every in (False, True))
    joint = {name: learner.joint.index[rows] for name, rows in learner.split.items()}
    with (
        np.load(tiny_run / "samples" / "factor-2" / "part-00001.npz") as part,
        np.load(tiny_run / "samples" / "part-00001.npz") as other,
    ):
        np.testing.assert_array_equal(part["latents"][:, 2:], other["latents"][:, 2:])
    total = {learner: len(joint["train"]) + len(joint["validation"]), half: 22 + 4, free: 22 + 4}
    for count in (60, 60, 120):
        index = np.arange(count)
        rows = {name: set(index[chosen]) for name, chosen in learner.factor_rows(index).items()}
        assert rows["train"] == set(index) - set(joint["test"]) - set(joint["validation"])
        assert rows["validation"] == set(index) & set(joint["validation"])
        some = {name: set(index[chosen]) for name, chosen in half.factor_rows(index).items()}
        assert some["train"] == set(index) & set(joint["train"][:22])
        assert free.factor_rows(index)["train"].tolist() == learner.factor_rows(index)["train"].tolist()
        for each, parts in ((learner, rows), (half, some), (free, rows)):
            total[each] += len(parts["train"]) + len(parts["validation"])
    assert {each: each.exponentials() for each in total} == total
    figures = json.loads((tiny_run / "evaluation.json").read_text())
    assert figures["exponentials"] == learner.exponentials()


def test_the_bundle_is_one_the_server_takes_and_computes_the_same(tiny_run: Path) -> None:
    folder = tiny_run / "models" / "tiny-torus" / "1"
    bundle = read_bundle(folder)
    assert bundle.manifest.figures == json.loads((tiny_run / "evaluation.json").read_text())
    assert bundle.manifest.onnx_tolerance.measured <= 1e-4
    measured = measure_accuracy(ShapeModel(bundle).decoder)
    assert bundle.manifest.auto_error == measured.auto_error
    assert bundle.manifest.draft_error
    assert bundle.manifest.draft_error.model_dump() == pytest.approx(measured.draft_error.model_dump(), rel=1e-6)
    text = b"".join(path.read_bytes() for path in folder.iterdir())
    assert str(Path(__file__).parents[3]).encode() not in text, "a bundle has no paths of its machine"

    run = Run(tiny_run, *load(tiny_run / "config.toml"), tiny_run / "models")
    composite = learner_of(run).main()
    codes = np.random.default_rng(4).uniform(0, 6, (5, 4)).astype(np.float32)
    with torch.no_grad():
        expected = composite(torch.from_numpy(codes)).numpy()
    shapes = [
        onnxruntime.InferenceSession(folder / f.file).run(None, {f.input: codes[:, f.start : f.stop]})[0]
        for f in bundle.manifest.factors
    ]
    combiner = onnxruntime.InferenceSession(folder / "combiner.onnx")
    answer = combiner.run(None, {"factors": np.stack(shapes, axis=1)})[0]
    norm = WeightedNorm.of(FreakyTorus().reference, 1e-2)
    assert np.sqrt(norm.square(answer - expected) / norm.square(expected)).max() < 1e-4


def test_fresh_codes_follow_from_the_networks_and_their_figure_is_that_of_the_bundle(tiny_run: Path) -> None:
    fresh = json.loads((tiny_run / "evaluation.json").read_text())["fresh"]
    torus, model = FreakyTorus(), shapespace.load(tiny_run / "models" / "tiny-torus")
    assert fresh["codes"] == 12, "as many as test codes"
    codes = torus.coordinates.uniform(12, np.random.default_rng(fresh["seed"]))
    assert hashlib.sha256(codes.tobytes()).hexdigest() == fresh["sha256"]
    assert not set(map(tuple, codes)) & set(map(tuple, read(tiny_run / "samples").latents))
    norm = WeightedNorm.of(torus.reference, 1e-2)
    found = r_squared(np.stack([model.decoder.nric(code) for code in codes]), torus.shapes(codes).nric, norm)
    assert found == pytest.approx(fresh["r2"]["composite"], abs=1e-4)
    assert set(fresh["r2"]) == {"composite", "monolithic", "monolithic_paper", "kernel"}
    assert json.loads((tiny_run / "evaluation.json").read_text())["limit"] is None, "shapes of a formula have no steps"


def test_a_run_killed_in_descent_ends_with_the_same_networks(tiny_run: Path, tmp_path: Path) -> None:
    config, copy = tmp_path / "tiny.toml", tmp_path / "run"
    config.write_text(TINY)
    until = command(config, copy, "--until", "networks")
    process = subprocess.Popen(until, stdout=subprocess.DEVNULL, start_new_session=True)
    while not list(copy.glob("networks/combiner-*.safetensors")):
        assert process.poll() is None, "the run ended before it could be killed"
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    subprocess.run(until, check=True, capture_output=True)
    one, other = (json.loads((run / "networks" / "histories.json").read_text()) for run in (tiny_run, copy))
    assert one == other
    for network in one:
        own, again = (read_network(run / "networks" / f"{network}.safetensors") for run in (tiny_run, copy))
        assert all(torch.equal(tensor, again.tensors[name]) for name, tensor in own.tensors.items())


def test_samples_keep_lengths_and_angles_of_the_formula(tiny_run: Path) -> None:
    torus = FreakyTorus()
    with np.load(tiny_run / "samples" / "part-00000.npz") as part:
        exact = nric(torus.shapes(part["latents"]).vertices, torus.reference.connectivity)
        half = exact.shape[1] // 2
        np.testing.assert_allclose(part["nric"][:, :half], exact[:, :half], atol=1e-6)
        turns = (part["nric"][:, half:] - exact[:, half:]) / (2 * np.pi)
        np.testing.assert_allclose(turns, np.round(turns), atol=1e-5)
