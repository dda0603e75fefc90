"""Stage `samples`: codes with their shapes, joint ones and each factor's own, and the split of the joint ones."""

import shutil
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapespace.coordinates.nric import dihedral_angles
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.mesh.triangle_quality import folded_anew
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.latent_coordinates import alone
from shapespace.training.runs.sampling import DERIVATIVES, DONE, KNOWN, columns, indices, parts, split, used
from shapespace.training.space.generalisation import RANDOM
from shapespace.training.stages.stage import Run, Stage, StageWarning, against_failures

#: Most samples of a straight-line model.
STRAIGHT_SAMPLES = RANDOM
#: A factor is named as the cause if lost codes lie farther from 0 in it than other codes, by this share of the box.
CLEARLY_FARTHER = 0.05


def draw_samples(run: Run) -> None:
    """Write the folder ``samples/``: joint samples, the collection's shapes, each factor's samples, and the split.

    Nothing is learned from samples of straight lines. A few joint samples measure the model.
    """
    settings, coordinates = run.config.samples, run.collection.coordinates
    directory, folder = run.directory, run.directory.samples
    code_rng, split_rng = (np.random.default_rng(s) for s in np.random.SeedSequence(settings.seed).spawn(2))
    straight, factors = directory.straight_kind(), run.collection.factors.values()
    count = min(settings.count, STRAIGHT_SAMPLES) if straight else settings.count
    own = [] if straight else settings.own(len(factors))
    codes = coordinates.drawn(settings.distribution, factors, max([count, *own]), code_rng)
    run.draw(folder, codes[:count], "joint samples", shorten=True)
    known = run.collection.codes
    if wanted := 0 if straight else min(len(known), count // 4) * settings.shapes:
        chosen = np.linspace(0, len(known) - 1, wanted).round().astype(int)
        run.draw(folder / KNOWN, known[chosen], "samples at the collection's shapes", shorten=True)
    else:
        shutil.rmtree(folder / KNOWN, ignore_errors=True)
    codes = used(folder, codes)
    for j, (index, count) in enumerate(zip(run.collection.factors.values(), own, strict=not straight)):
        run.draw(directory.factor_samples(j), alone(codes[:count], index), f"samples of factor {j}", shorten=True)
    rows = split(indices(folder), settings.test_fraction, settings.validation_fraction, split_rng)
    directory.split.write(**rows)
    differentiated, chosen = run.collection.differentiated, rows["train"][: settings.differentiated]
    if differentiated and len(chosen):
        run.draw(folder / DERIVATIVES, codes[chosen], "derivatives", shorten=False, collection=differentiated, few=True)
    else:
        shutil.rmtree(folder / DERIVATIVES, ignore_errors=True)


def _warnings(run: RunDirectory) -> list[StageWarning]:
    grouping = run.factors.read_if_written()
    others = "leave out the shapes farthest from the others, which make the range of codes large"
    advice = f"{against_failures(run)}; or {others}"
    warnings = []
    kinds = {"joint": run.samples}
    kinds |= {f"{name!r}": run.factor_samples(j) for j, name in enumerate(grouping.get("names", ()))}
    for kind, path in kinds.items():
        samples = columns(path, "asked", "latents", "status", "reason")
        if not samples:
            continue
        failed = samples["status"] != DONE
        shortened = (samples["latents"] != samples["asked"]).any(axis=1)
        if shortened.any():
            which = "joint samples" if kind == "joint" else f"samples of factor {kind}"
            where = _farthest(samples["asked"], shortened, grouping) if kind == "joint" else ""
            sentence = (
                f"{shortened.sum()} of {len(failed)} codes of {which} had no shape and were moved towards the "
                f"mean until they had one{where}"
            )
            warnings.append(StageWarning(sentence, float((shortened | failed).mean()), advice))
        if not failed.any():
            continue
        reason, _ = Counter(str(r).partition(":")[0] for r in samples["reason"][failed]).most_common(1)[0]
        if kind == "joint":
            where = _farthest(samples["latents"], failed, grouping)
            sentence = f"{failed.sum()} of {len(failed)} joint samples failed ({reason}){where}"
        else:
            sentence = f"{failed.sum()} of {len(failed)} samples of factor {kind} failed ({reason})"
        warnings.append(StageWarning(sentence, float(failed.mean()), advice))
    return warnings + _folded(run)


def _farthest(latents: NDArray, failed: NDArray, grouping: dict[str, Any]) -> str:
    """Return the end of a sentence that names the factor in which lost codes lie clearly farther from 0 than others."""
    names, factors = grouping.get("names", []), grouping.get("factors", [])
    if len(factors) < 2 or failed.all():
        return ""
    reach = np.abs(latents) / np.abs(latents).max(axis=0).clip(1e-300)
    by_factor = np.stack([reach[:, members].max(axis=1) for members in factors], axis=1)
    excess = by_factor[failed].mean(axis=0) - by_factor[~failed].mean(axis=0)
    return f", most in factor {names[int(excess.argmax())]!r}" if excess.max() > CLEARLY_FARTHER else ""


def _folded(run: RunDirectory) -> list[StageWarning]:
    """Count joint samples with two faces folded onto one another where no shape of the collection has a crease."""
    if not run.shapes.exists():
        return []
    connectivity = TriangleMesh.from_mapping(run.reference.read()).connectivity
    angles = dihedral_angles(run.shapes.read()["vertices"], connectivity)
    folded = count = 0
    for part in parts(run.samples):
        anew = folded_anew(part["nric"][:, connectivity.edge_count :], angles)
        folded, count = folded + int(anew.sum()), count + len(anew)
    sentence = f"{folded} of {count} joint samples have folded faces where no training shape has a crease"
    return [StageWarning(sentence)] if folded else []


STAGE = Stage(
    name="samples",
    version=1,
    settings=lambda config: [config.samples],
    run=draw_samples,
    results=lambda run: [run.samples],
    warnings=_warnings,
    amounts=frozenset({"count", "factor_counts", "shapes", "derivatives"}),
)
