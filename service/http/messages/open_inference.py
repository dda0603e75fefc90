"""JSON messages of the Open Inference Protocol.

The input is ``latent`` [n, m]. The outputs are ``nric`` [n, 2E] and ``vertices`` [n, V, 3], with the V vertices of the
fine mesh if the model has one. All are FP32 in row-major order.
https://github.com/open-inference/open-inference-protocol
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, field_validator
from pydantic.json_schema import SkipJsonSchema

from shapespace.model.decoder import MeshChoice
from shapespace.model.latent_space import Bounds
from shapespace.model.shape import Quality
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.messages.schemas import BoundsField, QualityField
from shapespace.service.refusals import RefusedError
from shapespace.service.use_cases.fields import Number, Whole

INPUT = "latent"
OutputName = Literal["nric", "vertices"]
PLATFORM = "shapespace"
OUTPUTS: tuple[OutputName, ...] = ("nric", "vertices")


class _Message(BaseModel):
    # Clients may send members that are meant for other servers; the protocol leaves them to each server.
    model_config = ConfigDict(extra="ignore")


class InputParameters(_Message):
    """Parameters of the input."""

    binary_data_size: SkipJsonSchema[Annotated[Whole, Field(ge=0)] | None] = Field(
        None, description="Number of bytes of this tensor after the JSON."
    )


_Numbers = Annotated[list[Number], Field(fail_fast=True)]


def _kind(data: object) -> str:
    """Return the tag of data by its first element. So a fault is told once, not for every kind of list."""
    if data is None:
        return "list[none]"
    return "list[list]" if isinstance(data, list) and isinstance(next(iter(data), None), list) else "list[number]"


_Data = Annotated[
    Annotated[_Numbers, Tag("list[number]")]
    | Annotated[list[_Numbers], Field(fail_fast=True), Tag("list[list]")]
    | Annotated[None, Tag("list[none]")],
    Discriminator(_kind),
]


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
        list[Annotated[Whole, Field(ge=0, json_schema_extra={"minimum": 1})]],
        Field(min_length=2, max_length=2, description="[n, m]"),
    ]
    datatype: Literal["FP32"]
    parameters: InputParameters = InputParameters(binary_data_size=None)
    data: _Data = Field(None, description="The numbers, as one list or as a list for each row; absent if bytes follow.")


class OutputParameters(_Message):
    """Parameters of an output."""

    binary_data: bool | None = Field(None, strict=True, description="Send this output as bytes after the JSON.")


class RequestedOutput(_Message):
    """An output that the client asks for."""

    name: OutputName
    parameters: OutputParameters = OutputParameters(binary_data=None)


class InferenceParameters(_Message):
    """Parameters of the whole request."""

    binary_data_output: bool = Field(
        False, strict=True, description="Send outputs as bytes, unless an output asks for JSON."
    )
    mesh: MeshChoice = Field(
        MeshChoice.FINE, description="The mesh whose vertices are answered, if the model has a fine one."
    )
    bounds: BoundsField = Bounds.ALLOW
    quality: QualityField = Quality.AUTO


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
        list[RequestedOutput], Field(fail_fast=True, description="Outputs to send, each at most once; by default both.")
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
                    raise RefusedError("malformed-request", f"outputs names {name} twice. Name each output once.")
            if len(given) > len(OUTPUTS):
                raise RefusedError("malformed-request", f"outputs has {len(given)} entries. Name each output once.")
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
    data: list[float] | None = Field(None, description="The numbers as one list, row by row; absent if bytes follow.")
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


class ModelLimits(BaseModel):
    """Limits on one request for a model."""

    max_codes: int = Field(description="Most codes for which both outputs are answered.")
    max_body: int = Field(description="Largest body in bytes.")
    deadline: float = Field(description="Seconds after which the answer is 504.")


class ModelMetadata(BaseModel):
    """Description of a model."""

    name: str
    versions: list[str]
    platform: str
    inputs: list[TensorMetadata]
    outputs: list[TensorMetadata]
    parameters: ModelLimits


class ServerMetadata(BaseModel):
    """Description of the server."""

    name: str
    version: str
    extensions: list[str]


class ModelReadiness(BaseModel):
    """Whether a model is served."""

    name: str
    ready: bool


class TensorConfiguration(BaseModel):
    """An input or output tensor, without the dimension of the batch."""

    name: str
    data_type: str
    dims: list[int]


class ModelConfiguration(BaseModel):
    """Configuration of a model, as Triton's extension has it."""

    name: str
    platform: str
    version_policy: dict[str, dict[str, int]] = Field(description="`all`: every version in the folder is served.")
    max_batch_size: int = Field(description="Most codes for which both outputs are answered.")
    input: list[TensorConfiguration]
    output: list[TensorConfiguration]


class InferenceDuration(BaseModel):
    """Number of requests, and their time together in nanoseconds."""

    count: int
    ns: int

    def add(self, seconds: float) -> None:
        """Count one request."""
        self.count += 1
        self.ns += round(1e9 * seconds)


class InferenceStatistics(BaseModel):
    """Requests by result, and the time of answered requests by stage."""

    success: InferenceDuration
    fail: InferenceDuration
    queue: InferenceDuration
    compute_input: InferenceDuration
    compute_infer: InferenceDuration
    compute_output: InferenceDuration


class ModelStatistics(BaseModel):
    """Inferences of one version of a model since the server started."""

    name: str
    version: str
    last_inference: int = Field(description="Milliseconds since 1970; 0 before the first answer.")
    inference_count: int = Field(description="Codes in requests that were answered.")
    execution_count: int = Field(description="Requests that were answered.")
    inference_stats: InferenceStatistics
    batch_stats: list[InferenceDuration] = Field(description="Empty: codes of several requests are not joined.")

    @classmethod
    def of(cls, model: ShapeModel) -> ModelStatistics:
        """Return the statistics of a model before its first inference."""
        parts = {part: InferenceDuration(count=0, ns=0) for part in InferenceStatistics.model_fields}
        return cls(
            name=model.manifest.name,
            version=model.manifest.version,
            last_inference=0,
            inference_count=0,
            execution_count=0,
            inference_stats=InferenceStatistics(**parts),
            batch_stats=[],
        )

    def succeed(self, codes: int, seconds: float, stages: Mapping[str, float]) -> None:
        """Count a request that was answered, with its time, and its time by stage, as in ``Server-Timing``."""
        self.last_inference = time.time_ns() // 10**6
        self.inference_count += codes
        self.execution_count += 1
        infer, output = stages.get("network", 0.0) + stages.get("reconstruct", 0.0), stages.get("encode", 0.0)
        self.inference_stats.success.add(seconds)
        # Shapes that are computed at the same time may take more time together than the request.
        self.inference_stats.queue.add(max(0.0, seconds - infer - output))
        self.inference_stats.compute_infer.add(infer)
        self.inference_stats.compute_output.add(output)


class StatisticsAnswer(BaseModel):
    """Inferences by version."""

    model_stats: list[ModelStatistics]


class IndexRequest(_Message):
    """Which models the index lists."""

    ready: bool = Field(False, strict=True, description="List only versions that are served.", examples=[True])


class IndexedModel(BaseModel):
    """A version of a model in the models folder."""

    name: str
    version: str
    state: Literal["READY", "UNAVAILABLE"]
    reason: str


def model_metadata(model: ShapeModel, versions: Sequence[str], limits: ModelLimits) -> ModelMetadata:
    """Return the description of a model with its tensors."""
    inputs, outputs = _tensors(model)
    return ModelMetadata(
        name=model.manifest.name,
        versions=list(versions),
        platform=PLATFORM,
        inputs=[TensorMetadata(name=name, datatype="FP32", shape=[-1, *row]) for name, row in inputs.items()],
        outputs=[TensorMetadata(name=name, datatype="FP32", shape=[-1, *row]) for name, row in outputs.items()],
        parameters=limits,
    )


def model_configuration(model: ShapeModel, limits: ModelLimits) -> ModelConfiguration:
    """Return the configuration of a model."""
    inputs, outputs = (
        [TensorConfiguration(name=name, data_type="TYPE_FP32", dims=row) for name, row in tensors.items()]
        for tensors in _tensors(model)
    )
    return ModelConfiguration(
        name=model.manifest.name,
        platform=PLATFORM,
        version_policy={"all": {}},
        max_batch_size=limits.max_codes,
        input=inputs,
        output=outputs,
    )


def _tensors(model: ShapeModel) -> tuple[dict[str, list[int]], dict[str, list[int]]]:
    """Return the shapes of the inputs and outputs for one code, by name."""
    facts = model.manifest
    vertices = [len(model.mesh(MeshChoice.FINE).vertices), 3]
    return {INPUT: [facts.latent_dimension]}, {"nric": [2 * facts.edges], "vertices": vertices}
