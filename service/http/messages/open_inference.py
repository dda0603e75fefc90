"""JSON messages of the Open Inference Protocol.

The input is ``latent`` [n, m]. The outputs are ``nric`` [n, 2E] and ``vertices`` [n, V, 3], with the V vertices of the
fine mesh if the model has one. All are FP32 in row-major order.
https://github.com/open-inference/open-inference-protocol
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, field_validator
from pydantic.json_schema import SkipJsonSchema

from shapespace.model.decoder import MeshChoice, Quality
from shapespace.model.latent_space import Bounds
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.messages.schemas import BoundsField, QualityField
from shapespace.service.http.problems import ProblemError
from shapespace.service.use_cases.fields import Number

INPUT = "latent"
OutputName = Literal["nric", "vertices"]
OUTPUTS: tuple[OutputName, ...] = ("nric", "vertices")


class _Message(BaseModel):
    # Clients may send members that are meant for other servers; the protocol says to ignore them.
    model_config = ConfigDict(extra="ignore")


class InputParameters(_Message):
    """Parameters of the input."""

    binary_data_size: SkipJsonSchema[NonNegativeInt | None] = Field(
        None, description="Number of its bytes after the JSON."
    )


_Numbers = Annotated[list[Number], Field(fail_fast=True)]


def _as_json(schema: dict[str, Any]) -> None:
    """Require ``data``: this schema is for bodies without bytes after the JSON.

    The items are not described: clients of openapi-generator in Java can't be compiled with two kinds of lists.
    """
    schema["required"].append("data")
    data = schema["properties"]["data"]
    schema["properties"]["data"] = {"type": "array", "items": {}, "title": "Data", "description": data["description"]}


class InputTensor(_Message):
    """The latent codes."""

    model_config = ConfigDict(json_schema_extra=_as_json)

    name: Literal["latent"]
    shape: Annotated[
        list[Annotated[int, Field(ge=0, json_schema_extra={"minimum": 1})]],
        Field(min_length=2, max_length=2, description="[n, m]"),
    ]
    datatype: Literal["FP32"]
    parameters: InputParameters = InputParameters(binary_data_size=None)
    data: _Numbers | Annotated[list[_Numbers], Field(fail_fast=True)] | SkipJsonSchema[None] = Field(
        None, description="The numbers, flat or one list for each row; absent if bytes follow."
    )


class OutputParameters(_Message):
    """Parameters of an output."""

    binary_data: bool | None = Field(None, strict=True, description="Send it as bytes after the JSON.")


class RequestedOutput(_Message):
    """An output that the client asks for."""

    name: OutputName
    parameters: OutputParameters = OutputParameters(binary_data=None)


class InferenceParameters(_Message):
    """Parameters of the whole request."""

    binary_data_output: bool = Field(
        False, strict=True, description="Send all outputs as bytes, unless one says otherwise."
    )
    mesh: MeshChoice = Field(
        MeshChoice.FINE, description="The mesh whose vertices are answered, if the model has a fine one."
    )
    bounds: BoundsField = Bounds.ALLOW
    quality: QualityField = Quality.FULL


class InferenceRequest(_Message):
    """Codes, and the outputs that the client asks for."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "inputs": [{"name": "latent", "shape": [1, 4], "datatype": "FP32", "data": [1, 2, 3, 4]}],
                    "outputs": [{"name": "nric"}],
                }
            ]
        }
    )

    id: str | None = Field(None, description="Repeated in the answer.")
    inputs: Annotated[list[InputTensor], Field(min_length=1, max_length=1)]
    outputs: Annotated[
        list[RequestedOutput], Field(fail_fast=True, description="Both by default; each at most once.")
    ] = []
    parameters: InferenceParameters = InferenceParameters()

    @field_validator("outputs", mode="before")
    @classmethod
    def _each_once(cls, given: object) -> object:
        # Before validation, because a list may have any number of outputs, and each would be computed.
        if isinstance(given, list):
            names = [output.get("name") for output in given[: len(OUTPUTS) + 1] if isinstance(output, dict)]
            for name in OUTPUTS:
                if names.count(name) > 1:
                    raise ProblemError("malformed-request", f"outputs names {name} twice. Name each output once.")
            if len(given) > len(OUTPUTS):
                raise ProblemError("malformed-request", f"outputs has {len(given)} entries. Name each output once.")
        return given

    @property
    def output_names(self) -> list[OutputName]:
        """Names of the outputs to answer."""
        return [output.name for output in self.outputs] or list(OUTPUTS)

    def binary(self, name: str) -> bool:
        """Return whether an output follows the JSON as bytes."""
        asked = [output.parameters.binary_data for output in self.outputs if output.name == name]
        return self.parameters.binary_data_output if not asked or asked[0] is None else asked[0]


class OutputTensor(BaseModel):
    """An output tensor."""

    name: OutputName
    shape: list[int]
    datatype: Literal["FP32"]
    data: list[float] | None = Field(None, description="Flat, row by row; absent if bytes follow.")
    parameters: dict[str, int] | None = Field(None, description="`binary_data_size`, if bytes follow.")


class InferenceAnswer(BaseModel):
    """The outputs of a model."""

    model_name: str
    model_version: str
    id: str | None = None
    outputs: list[OutputTensor]


class TensorMetadata(BaseModel):
    """An input or output tensor; −1 stands for any size."""

    name: str
    datatype: str
    shape: list[int]


class ModelMetadata(BaseModel):
    """Description of a model."""

    name: str
    versions: list[str]
    platform: str
    inputs: list[TensorMetadata]
    outputs: list[TensorMetadata]


class ServerMetadata(BaseModel):
    """Description of the server."""

    name: str
    version: str
    extensions: list[str]


class ModelReadiness(BaseModel):
    """Whether a model is served."""

    name: str
    ready: bool


def model_metadata(model: ShapeModel, versions: Sequence[str]) -> ModelMetadata:
    """Return the description of a model with its tensors."""
    facts = model.manifest
    fine = len(model.mesh(MeshChoice.FINE).vertices)
    return ModelMetadata(
        name=facts.name,
        versions=list(versions),
        platform="shapespace",
        inputs=[TensorMetadata(name=INPUT, datatype="FP32", shape=[-1, facts.latent_dimension])],
        outputs=[
            TensorMetadata(name="nric", datatype="FP32", shape=[-1, 2 * facts.edges]),
            TensorMetadata(name="vertices", datatype="FP32", shape=[-1, fine, 3]),
        ],
    )
