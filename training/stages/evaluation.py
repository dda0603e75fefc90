"""Stage `evaluation`: all figures of a run, from the test codes and from fresh codes."""

import itertools

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.provenance import MADE_BY, made_by
from shapespace.training.runs.sampling import DONE, Collection, parts, read
from shapespace.training.space.generalisation import RANDOM, PrincipalComponents, to_nearest
from shapespace.training.stages.networks import learner_of
from shapespace.training.stages.stage import TOLERATED_LOSS, Run, Stage, StageWarning


def measure_run(run: Run) -> None:
    """Write ``evaluation.json`` and ``gallery.npz``."""
    from shapespace.training.learning.baselines import Exact
    from shapespace.training.learning.evaluation import evaluate

    directory = run.directory

    def exact(name: str, latents: FloatArray, collection: Collection | None = None) -> Exact:
        folder = directory.exact / name
        run.draw(folder, latents, f"exact shapes, {name}", shorten=False, collection=collection, few=True)
        samples = read(folder)

        def each(values: NDArray[np.float32]) -> NDArray[np.float32]:
            result = np.full((len(latents), *values.shape[1:]), np.nan, dtype=np.float32)
            result[samples.index] = values
            return result

        return Exact(each(samples.nric), each(samples.vertices))

    figures, gallery = evaluate(learner_of(run), exact)
    if directory.ingest.exists():
        figures["prolongation"] = directory.ingest.read().get("prolongation")
    unseen = directory.generalisation.read_if_written()
    if unseen and "failed" not in unseen:
        figures["generalisation"] = {name: fact for name, fact in unseen.items() if name != MADE_BY}
    if not run.by_design:
        figures |= compactness_and_specificity(directory)
    directory.gallery.write(**gallery)
    directory.evaluation.write({MADE_BY: made_by()} | figures)


def compactness_and_specificity(run: RunDirectory) -> dict[str, dict[str, float]]:
    """Return both figures for the ``modes`` and as many principal ``components`` of the vertices (Davies et al. 2002).

    Compactness is the explained share of the variance, for logarithms or for aligned vertices. Specificity is the mean
    distance between random shapes and the nearest shape of the collection, as a share of the diagonal. Random shapes
    are uniform in the bounds of codes, where they are the first joint samples, or of coefficients.
    """
    shapes, reference, found = run.own_shapes(), run.reference_mesh(), run.decomposition.read()
    # Read as few files as are needed: all samples may be gigabytes.
    random = itertools.chain.from_iterable(part["vertices"][part["status"] == DONE] for part in parts(run.samples))
    drawn = np.array(list(itertools.islice(random, RANDOM)), dtype=np.float64)
    linear = PrincipalComponents.of(shapes, reference.vertices)
    others = linear.random(found["modes"], len(drawn), np.random.default_rng(0))
    away = [to_nearest(each, shapes, reference.diagonal) for each in (drawn, others)]
    return {
        "compactness": {"modes": found["explained"], "components": linear.explained(found["modes"])},
        "specificity": dict(zip(("modes", "components"), away, strict=True)),
    }


def _warnings(run: RunDirectory) -> list[StageWarning]:
    figures = run.evaluation.read_if_written()
    warnings = []
    statuses = figures.get("vertex_error", {}).get("status", {})
    stalled, count = sum(n for status, n in statuses.items() if status != "converged"), sum(statuses.values())
    if stalled:
        sentence = f"Gauss–Newton did not converge for {stalled} of {count} test shapes"
        warnings.append(StageWarning(sentence))
    total = figures.get("r2", {}).get("composite", {}).get("total", 1.0)
    if not total > 1 - TOLERATED_LOSS:
        sentence = f"the networks are inaccurate: R² is {total:.2f}; a larger samples.count may help"
        warnings.append(StageWarning(sentence))
    return warnings


STAGE = Stage(
    name="evaluation",
    version=2,
    # Without baselines, the digest is the same as in version 0.2, and the stage is not done again.
    settings=lambda config: [config.evaluation, config.export.model_dump(include={"eta_reconstruction"})],
    run=measure_run,
    results=lambda run: [run.evaluation.path, run.gallery.path, run.report.path, run.exact],
    warnings=_warnings,
)
