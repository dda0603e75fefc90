"""docs/measurements/freaky-torus-paper.png and its neighbours: figures of the paper, with its system as trained here.

``python -m benchmarks.paper_pictures RUN`` draws shapes of the paper's models, the factors of the torus, and an
interpolation. RUN is the folder that ``benchmarks.paper`` has trained.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from benchmarks.pages import MEASUREMENTS
from benchmarks.pictures import CODES, SIZE, compared, save
from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import nric
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.rigid_motion import align
from shapespace.training.learning.composite import Composite, affine_sum
from shapespace.training.learning.evaluation import strip
from shapespace.training.learning.learner import PAPER_PERCEPTRON, Learner
from shapespace.training.learning.networks import predict
from shapespace.training.report.pictures import CLAY, Studio
from shapespace.training.report.rendering import Camera
from shapespace.training.runs.config import load
from shapespace.training.runs.latent_coordinates import alone
from shapespace.training.runs.sampling import Collection
from shapespace.training.stages.networks import learner_of
from shapespace.training.stages.stage import Run

#: Seed of the codes whose shapes are drawn, and number of positions of each factor.
SEED, POSITIONS = 1, 6


def models(learner: Learner, composite: Composite, eta: float, path: Path) -> None:
    """Draw shapes of random codes: exact, by the paper's two networks, and by the affine sum of exact factors."""
    collection = learner.collection
    codes = collection.coordinates.uniform(CODES, np.random.default_rng(SEED))
    latents, reference = torch.as_tensor(codes, dtype=torch.float32), collection.reference
    parts = [collection.shapes(alone(codes, index)).nric for index in collection.factors.values()]
    exact = align(collection.shapes(codes).vertices.astype(np.float64), reference.vertices)
    rest = nric(reference.vertices, reference.connectivity)
    single = learner.joint_network("monolithic-paper", PAPER_PERCEPTRON)
    found = {
        "the paper's system": predict(composite, latents).numpy(),
        "its monolithic network": predict(single, latents).numpy(),
        "affine sum, exact factors": affine_sum(rest, np.stack(parts, axis=1)),
    }
    compared(found, exact, studio(collection, exact), Reconstructor(reference, eta), path)


def factors(collection: Collection, path: Path) -> None:
    """Draw what each factor alone does to the reference, over a period of its latents."""
    positions = np.linspace(0, 1, POSITIONS, endpoint=False)
    codes = collection.coordinates.lower + positions[:, None] * collection.coordinates.period
    rows = np.stack([collection.shapes(alone(codes, index)).vertices for index in collection.factors.values()])
    titles = [f"{360 * position:.0f}°" for position in positions]
    draw(collection, rows.astype(np.float64), titles, list(collection.factors), path)


def interpolation(collection: Collection, composite: Composite, eta: float, path: Path) -> None:
    """Draw an interpolation between two codes, and in a row for each factor network the shape that it puts out."""
    found = strip(collection, composite, eta)
    rows = np.concatenate([found["strip_joint"][None], found["strip_factors"]])
    titles = [f"t = {t:.2f}" for t in np.linspace(0, 1, rows.shape[1])]
    draw(collection, rows, titles, ["all factors together", *collection.factors], path)


def draw(collection: Collection, rows: FloatArray, titles: list[str], names: list[str], path: Path) -> None:
    """Draw rows (k, T, V, 3) of shapes, one column for each title."""
    shapes = np.stack([align(row, collection.reference.vertices) for row in rows])
    camera = studio(collection, shapes.reshape(-1, *shapes.shape[2:]))
    columns = [
        (title, [camera.pixels(shape, SIZE, CLAY) for shape in column])
        for title, column in zip(titles, shapes.swapaxes(0, 1), strict=True)
    ]
    save(columns, path, f"from top to bottom: {', '.join(names)}")


def studio(collection: Collection, shapes: FloatArray) -> Studio:
    """Return a camera that holds all shapes (n, V, 3)."""
    reference = collection.reference
    base, faces = reference.vertices, reference.connectivity.faces
    return Studio(Camera.facing(base, faces, np.concatenate([base[None], shapes])), base, faces)


def main() -> None:
    """Draw the three pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="folder of the run, below the folder --out of benchmarks.paper")
    given = parser.parse_args()
    stored = given.run / "config.toml"
    run = Run(given.run, *load(stored, stored=stored), given.run / "models")
    learner, eta = learner_of(run), run.config.export.eta_reconstruction
    composite = learner.paper()
    models(learner, composite, eta, MEASUREMENTS / "freaky-torus-paper.png")
    factors(learner.collection, MEASUREMENTS / "freaky-torus-factors.png")
    interpolation(learner.collection, composite, eta, MEASUREMENTS / "freaky-torus-interpolation.png")


if __name__ == "__main__":
    main()
