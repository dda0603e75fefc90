"""Model cards: what a model is, how exact it is, and where it comes from."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from shapespace.bundle.schema import AttributesEntry


class FactorSummary(BaseModel):
    """A factor and its range of latent coordinates, the last excluded."""

    name: str
    start: int
    stop: int


class ModelSummary(BaseModel):
    """A model in the list."""

    name: str
    version: str
    title: str
    description: str
    licence: str
    latent_dimension: int
    latent_names: list[str]
    factors: list[FactorSummary]
    lower: list[float] = Field(description="Lower bound of each coordinate.")
    upper: list[float] = Field(description="Upper bound of each coordinate.")
    period: list[float | None] = Field(description="Period of each coordinate that is an angle, else null.")
    vertices: int
    edges: int
    faces: int
    surface: AttributesEntry | None = Field(
        description="What answers of the fine mesh keep from the training files: names of parts, materials, "
        "textures, and whether the files had normals. Null if there is nothing but triangles."
    )
    links: dict[str, str] = Field(description="Addresses of the model's calls.")


class ModelList(BaseModel):
    """Every model, in its default version."""

    models: list[ModelSummary]


class DistanceAnswer(BaseModel):
    """Distance of vertices, as shares of the bounding box's diagonal."""

    mean: float
    p95: float = Field(description="95th percentile.")


class GeneralisationAnswer(DistanceAnswer):
    """Distance of vertices of shapes that were held out, beside as many principal components of aligned vertices."""

    components: DistanceAnswer
    shapes: int = Field(description="Number of unseen shapes.")
    modes: float = Field(description="Number of modes; a mean if the folds differ.")


class BesideComponents(BaseModel):
    """A figure of a space, and the same of as many principal components of aligned vertices."""

    modes: float
    components: float


class ModelCard(ModelSummary):
    """What a model is, how good it is, and where it comes from."""

    model_config = ConfigDict(populate_by_name=True)

    versions: list[str] = Field(description="Versions that are served, oldest first.")
    digest: str = Field(description="SHA-256 of the manifest, which holds the digests of all its files.")
    scale: float = Field(description="Length of one normalised unit in the units of the training meshes.")
    mu: float
    lambda_: float = Field(alias="lambda")
    eta: float = Field(description="Weight of bending in the metric.")
    eta_reconstruction: float = Field(description="Weight of the angles in Gauss–Newton.")
    onnx_tolerance: dict[str, float]
    figures: dict[str, Any] = Field(description="Evaluation figures on the test split.")
    generalisation: GeneralisationAnswer | None = Field(
        description="Error of the modes on unseen shapes; null if it was not measured."
    )
    compactness: BesideComponents | None = Field(
        description="Explained share of the variance of the training shapes; null if it was not measured."
    )
    specificity: BesideComponents | None = Field(
        description="Mean distance of random shapes from the nearest training shape, as a share of the bounding "
        "box's diagonal; null if it was not measured."
    )
    draft_error: DistanceAnswer | None = Field(
        description="Distance of drafts from full shapes, over codes inside the bounds; null if it was not measured."
    )
    auto_error: DistanceAnswer | None = Field(
        description="Distance of shapes of quality `auto` from full shapes, likewise; null if it was not measured."
    )
    origin: dict[str, Any]
