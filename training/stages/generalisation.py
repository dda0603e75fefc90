"""Stage `generalisation`: the distance between shapes that are left out of training and the space without them."""

from typing import Any

from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.provenance import MADE_BY, made_by
from shapespace.training.space.generalisation import summary
from shapespace.training.space.geometry import COST, hopeful
from shapespace.training.space.held_out import held_out, joined
from shapespace.training.space.modes import ModeError
from shapespace.training.space.related import Related
from shapespace.training.stages.stage import Run, Stage, StageWarning


def measure_generalisation(run: Run) -> None:
    """Write ``generalisation.json``: errors of modes and of principal components on shapes left out of training.

    A fifth of the shapes is left out of mean, logarithms, modes and their number, and of the choice of the map. Maps
    that were clearly worse on all shapes are not compared again, nor local fields that did not help. Below ten shapes,
    each is left out in its turn. Related shapes are left out together. Exponentials stand for networks, in at most
    LIGHT_STEPS steps. The space remembers the other shapes if the bundle does. The same is measured with half as many
    modes.
    ``least-general.npz`` has the shape with the largest error.
    """
    directory, material = run.directory, run.config.shell_material
    reference, given, settings = directory.reference_mesh(), directory.shapes.read(), run.config.modes
    shapes, related, first_step = given["vertices"], Related.of_arrays(given), run.config.exponential.first_step
    chosen = directory.geometry.read_if_written()
    some = related.folds()[: None if related.few else 1]
    facts: dict[str, Any]
    try:
        how: dict[str, Any] = {
            "related": related,
            "first_step": first_step,
            "remember": run.config.export.examples,
            "among": hopeful(chosen["kind"], chosen["errors"]) if chosen else COST,
            "vary": bool(chosen.get("local_share")),
        }
        found = joined([held_out(reference, shapes, each, None, settings, material, **how) for each in some])
    except (ModeError, NotPositiveDefiniteError) as error:  # the model is still of use
        facts = {"failed": str(error)}
    else:
        away = found.distances(shapes, reference.diagonal)
        worst = int(away["modes"][-1].mean(axis=1).argmax())
        number = found.index[worst]
        directory.least_general.write(given=shapes[number], found=found.near["modes"][-1][worst])
        different = slice(0 if found.counts[0] < found.counts[1] else 1, None)
        ended = ~found.stuck[-1]
        facts = {
            "held_out": len(found.index),
            **({"groups": related.groups} if "group" in given else {}),
            "maps": sorted(set(found.maps)),
            "steps": int(found.steps.max()),
            "counts": found.counts[different],
            **{name: [summary(each) for each in rows[different]] for name, rows in away.items()},
            "stuck": int((~ended).sum()),
            "not_stuck": {name: summary(rows[-1][ended]) for name, rows in away.items() if ended.any()},
            "worst": str(given["names"][number]),
        }
    directory.generalisation.write({MADE_BY: made_by()} | facts)
    directory.log("found", **facts)


def _warnings(run: RunDirectory) -> list[StageWarning]:
    why = run.generalisation.read_if_written().get("failed")
    return [StageWarning(f"the error on unseen shapes was not measured: {why}")] if why else []


STAGE = Stage(
    name="generalisation",
    version=1,
    # Runs of version 0.2, which had exponentials and remembered examples by default, keep their key.
    settings=lambda config: (
        []
        if config.modes.geometry == "exponential" and config.export.examples
        else [config.export.model_dump(include={"examples"})]
    ),
    run=measure_generalisation,
    results=lambda run: [run.generalisation.path, run.least_general.path],
    warnings=_warnings,
    meshes_only=True,
)
