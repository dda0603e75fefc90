"""What each stage of a run could not do, in sentences, read from the files that it left."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapespace.coordinates.nric import dihedral_angles
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.mesh.triangle_quality import folded_anew
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.sampling import DONE, columns, parts

#: The run stops if a larger share of logarithms or samples could not be computed.
MOST_LOST = 0.25
#: A factor is named as the cause where, in it, lost codes lie farther from 0 than the others by this share of the box.
CLEARLY = 0.05
#: Most names in a sentence.
NAMED = 6

COARSER = (
    "more collection.coarse_vertices or a larger material.eta, as the usual cause are thin or folded parts of the "
    "coarse mesh"
)


class LostTooMuchError(RuntimeError):
    """A stage lost too many logarithms or samples. What it did stays; the message says how to go on."""


@dataclass(frozen=True)
class StageWarning:
    """One thing that a stage could not do.

    Attributes:
        sentence: what, how much, and where.
        share: of the logarithms or samples that are lost; 0 for what never stops a run.
        advice: what may help, where the share is large.
    """

    sentence: str
    share: float = 0.0
    advice: str = ""

    @property
    def too_much(self) -> bool:
        """Whether the run should stop."""
        return self.share > MOST_LOST


def shortfalls(run: RunDirectory, stage: str) -> list[StageWarning]:
    """What a finished stage could not do."""
    return _STAGES[stage](run) if stage in _STAGES else []


def refuse(stage: str, lost: list[StageWarning], command: str = "") -> None:
    """Stop a run that has lost too much.

    Raises:
        LostTooMuchError: with what was lost, what may help, and the command that goes on all the same.
    """
    grave = [each for each in lost if each.too_much]
    if grave:
        why = "; ".join(each.sentence for each in grave)
        advice = "; ".join(dict.fromkeys(each.advice for each in grave))
        raise LostTooMuchError(
            f"stopped after {stage}: {why}, more than a quarter, and what is learned from the rest is worth little.\n"
            f"What may help: {advice}." + (f"\nTo go on all the same: {command}" if command else "")
        )


def _some(names: list[str]) -> str:
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def _ingest(run: RunDirectory) -> list[StageWarning]:
    facts = run.ingest.read_if_written()
    sentences = [*facts.get("notes", ()), *facts.get("warnings", ())]
    if facts.get("reason"):
        sentences.append(f"coarse mesh: {facts['reason']}")
    return [StageWarning(sentence) for sentence in sentences]


def _modes(run: RunDirectory) -> list[StageWarning]:
    facts = run.decomposition.read_if_written()
    if "steps" not in facts:
        return []
    names = run.shapes.read()["names"].astype(str)
    steps, asked, found = np.array(facts["steps"]), facts["asked"], facts["modes"]
    lost = []
    linearised = names[steps == 0].tolist()
    if linearised:
        sentence = f"linearised {len(linearised)} of {len(steps)} logarithms: {_some(linearised)}"
        lost.append(StageWarning(sentence, len(linearised) / len(steps), COARSER))
    finer = names[steps > facts["log_steps"]].tolist()
    if finer:
        lost.append(
            StageWarning(f"took twice as many steps for {len(finer)} of {len(steps)} logarithms: {_some(finer)}")
        )
    if found < asked:
        why = (
            f"{len(steps)} shapes differ in {found} directions"
            if found == len(steps) - 1
            else "the others would be zero; a smaller modes.sparsity keeps more, where it isn't 0 already"
        )
        lost.append(StageWarning(f"found {found} of {asked} modes, because {why}"))
    unfinished = names[np.array(facts.get("codes", ["converged"] * len(names))) != "converged"].tolist()
    if unfinished:
        sentence = f"the codes of {len(unfinished)} of {len(names)} shapes may not be the nearest: {_some(unfinished)}"
        lost.append(StageWarning(sentence))
    if not facts.get("converged", True):
        lost.append(StageWarning("sparse modes: the iteration ended at modes.max_iterations, before it had converged"))
    return lost


def _samples(run: RunDirectory) -> list[StageWarning]:
    grouping = run.factors.read_if_written()
    advice = f"{COARSER}; or without the shapes farthest from the others, which make the box of codes large"
    lost = []
    kinds = {"joint": run.samples}
    kinds |= {f"{name!r}": run.factor_samples(j) for j, name in enumerate(grouping.get("names", ()))}
    for kind, path in kinds.items():
        samples = columns(path, "asked", "latents", "status", "reason")
        if not samples:
            continue
        failed = samples["status"] != DONE
        shortened = (samples["latents"] != samples["asked"]).any(axis=1)
        if shortened.any():
            whose = "joint samples" if kind == "joint" else f"samples of factor {kind}"
            where = _farthest(samples["asked"], shortened, grouping) if kind == "joint" else ""
            sentence = f"shortened {shortened.sum()} of {len(failed)} codes of {whose} until they had a shape{where}"
            lost.append(StageWarning(sentence, float((shortened | failed).mean()), advice))
        if not failed.any():
            continue
        reason, _ = Counter(str(r).partition(":")[0] for r in samples["reason"][failed]).most_common(1)[0]
        if kind == "joint":
            where = _farthest(samples["latents"], failed, grouping)
            sentence = f"failed {failed.sum()} of {len(failed)} joint samples ({reason}){where}"
        else:
            sentence = f"failed {failed.sum()} of {len(failed)} samples of factor {kind} ({reason})"
        lost.append(StageWarning(sentence, float(failed.mean()), advice))
    return lost + _folded(run)


def _folded(run: RunDirectory) -> list[StageWarning]:
    """Joint samples with two faces folded onto one another where no shape of the collection has as much as a crease."""
    if not run.shapes.exists():
        return []
    connectivity = TriangleMesh.from_mapping(run.reference.read()).connectivity
    angles = dihedral_angles(run.shapes.read()["vertices"], connectivity)
    folded = count = 0
    for part in parts(run.samples):
        anew = folded_anew(part["nric"][:, connectivity.edge_count :], angles)
        folded, count = folded + int(anew.sum()), count + len(anew)
    return [StageWarning(f"folded {folded} of {count} joint samples where no shape has a crease")] if folded else []


def _farthest(latents: NDArray, failed: NDArray, grouping: dict[str, Any]) -> str:
    """The end of a sentence: in which factor lost codes lie clearly farther from 0 than others do, if in any."""
    names, factors = grouping.get("names", []), grouping.get("factors", [])
    if len(factors) < 2 or failed.all():
        return ""
    reach = np.abs(latents) / np.abs(latents).max(axis=0).clip(1e-300)
    by_factor = np.stack([reach[:, members].max(axis=1) for members in factors], axis=1)
    excess = by_factor[failed].mean(axis=0) - by_factor[~failed].mean(axis=0)
    return f", most in factor {names[int(excess.argmax())]!r}" if excess.max() > CLEARLY else ""


def _evaluation(run: RunDirectory) -> list[StageWarning]:
    figures = run.evaluation.read_if_written()
    lost = []
    statuses = figures.get("vertex_error", {}).get("status", {})
    stalled, count = sum(n for status, n in statuses.items() if status != "converged"), sum(statuses.values())
    if stalled:
        lost.append(
            StageWarning(f"{stalled} of {count} test shapes were not quite found from their lengths and angles")
        )
    total = figures.get("r2", {}).get("composite", {}).get("total", 1.0)
    if not total > 1 - MOST_LOST:
        lost.append(StageWarning(f"the networks miss much: R² {total:.2f}; a larger samples.count may help"))
    return lost


def _export(run: RunDirectory) -> list[StageWarning]:
    facts = run.encoded.read_if_written()
    outside = facts.get("outside", [])
    if not outside:
        return []
    return [
        StageWarning(
            f"the codes of {len(outside)} of {facts['shapes']} shapes lie outside the bounds: {_some(outside)}"
        )
    ]


def _generalisation(run: RunDirectory) -> list[StageWarning]:
    why = run.generalisation.read_if_written().get("failed")
    return [StageWarning(f"how near the space comes to unseen shapes was not measured: {why}")] if why else []


_STAGES: dict[str, Callable[[RunDirectory], list[StageWarning]]] = {
    "ingest": _ingest,
    "modes": _modes,
    "samples": _samples,
    "generalisation": _generalisation,
    "evaluation": _evaluation,
    "export": _export,
}
