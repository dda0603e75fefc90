"""The list of models, and the card of each model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fastapi import APIRouter, Request, Response
from pydantic import ValidationError

from shapespace.files.reading import OCTET_STREAM
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.caching import cache_headers, entity_tag, not_modified
from shapespace.service.http.dependencies import Model, ServiceDependency
from shapespace.service.http.description import binary, problems
from shapespace.service.http.messages.cards import (
    BesideComponents,
    GeneralisationAnswer,
    ModelCard,
    ModelList,
    ModelSummary,
)
from shapespace.service.http.responses import RangedFile
from shapespace.service.refusals import RefusedError

router = APIRouter(prefix="/v1/models", tags=["models"])


@router.get("")
async def list_models(service: ServiceDependency) -> ModelList:
    """Every model, in its default version."""
    return ModelList(models=[ModelSummary(**_facts(model)) for model in service.repository])


@router.get("/{name}", responses=problems(404, 422))
async def model_card(service: ServiceDependency, model: Model) -> ModelCard:
    """Description of a model: its bounds, measured figures, and origin."""
    return ModelCard(
        **_facts(model),
        digest=model.digest,
        versions=service.repository.versions(model.manifest.name),
        generalisation=_generalisation(model.manifest.figures),
        compactness=_beside_components(model.manifest.figures, "compactness"),
        specificity=_beside_components(model.manifest.figures, "specificity"),
    )


@router.get(
    "/{name}/decoder.onnx",
    responses=binary({"onnx": OCTET_STREAM}, "The file `decoder.onnx` of the bundle.") | problems(404, 416, 422),
    response_class=Response,
)
async def model_decoder(request: Request, model: Model) -> Response:
    """The graph that turns codes into vertices in any ONNX runtime, if the model has one."""
    entry = model.manifest.decoder
    if entry is None:
        name = model.manifest.name
        raise RefusedError("not-found", f"{name} has no decoder.onnx. `shapespace export` adds it to a bundle.")
    tag = entity_tag("decoder", model.manifest.files[entry.file].sha256)
    if unchanged := not_modified(request, tag):
        return unchanged
    return RangedFile(model.folder / entry.file, media_type=OCTET_STREAM, headers=cache_headers(tag))


def _generalisation(figures: Mapping[str, Any]) -> GeneralisationAnswer | None:
    """Return figures for the largest number of modes; None if they are missing or have another form."""
    try:
        found = figures["generalisation"]
        content = {**found["modes"][-1], "components": found["components"][-1]}
        content |= {"shapes": found["held_out"], "modes": found["counts"][-1]}
        return GeneralisationAnswer.model_validate(content)
    except (KeyError, IndexError, TypeError, ValidationError):
        return None


def _beside_components(figures: Mapping[str, Any], name: str) -> BesideComponents | None:
    """Return a figure by its name; None if it is missing or has another form."""
    try:
        return BesideComponents.model_validate(figures.get(name))
    except ValidationError:
        return None


def _facts(model: ShapeModel) -> dict[str, Any]:
    facts = model.manifest.model_dump(by_alias=True)
    path = f"/v1/models/{model.manifest.name}"
    links = {"self": path}
    if not any(model.manifest.period):
        links["blendshapes"] = f"{path}/blendshapes"
    links |= {
        call: f"{path}/{call}"
        for call in ("mesh", "vertices", "nric", "interpolations", "encode", "fit", "edit", "sample")
    }
    if model.manifest.decoder:
        links["decoder"] = f"{path}/decoder.onnx"
    wanted = ModelCard.model_fields
    names = [field.alias or name for name, field in wanted.items()]
    return {name: facts[name] for name in names if name in facts} | {"links": links}
