"""The Open Inference Protocol's messages: JSON, and the extension that lets tensors follow it as bytes.

One input, ``latent`` [n, m]; two outputs, ``nric`` [n, 2E] and ``vertices`` [n, V, 3], V being the fine mesh's where
there is one. All are FP32, row-major, little-endian where binary.
https://github.com/open-inference/open-inference-protocol and, for the bytes,
https://github.com/triton-inference-server/server/blob/main/docs/protocol/extension_binary_data.md
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, field_validator
from pydantic.json_schema import SkipJsonSchema

from shapespace.files.archives import Buffer
from shapespace.model.decoder import MeshChoice, Quality
from shapespace.model.latent_space import Bounds
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.messages import bodies
from shapespace.service.http.messages.schemas import BoundsField, QualityField
from shapespace.service.http.problems import ProblemError
from shapespace.service.use_cases.fields import Number
from shapespace.service.use_cases.shape_formats import dump_json

#: How long the JSON part of a body is, where bytes follow it.
HEADER = "Inference-Header-Content-Length"
INPUT = "latent"
OutputName = Literal["nric", "vertices"]
OUTPUTS: tuple[OutputName, ...] = ("nric", "vertices")
_FLOAT = np.dtype("<f4")


class _Message(BaseModel):
    # Clients send parameters and members of other servers: the protocol has them ignored.
    model_config = ConfigDict(extra="ignore")


class InputParameters(_Message):
    """What may go with the input."""

    binary_data_size: SkipJsonSchema[NonNegativeInt | None] = Field(None, description="Its bytes after the JSON.")


_Numbers = Annotated[list[Number], Field(fail_fast=True)]


def _as_json(schema: dict[str, Any]) -> None:
    """Numbers are required in JSON: where bytes follow it, the body has another media type and no schema."""
    schema["required"].append("data")
    del schema["properties"]["data"]["default"]


class InputTensor(_Message):
    """The codes."""

    model_config = ConfigDict(json_schema_extra=_as_json)

    name: Literal["latent"]
    shape: Annotated[
        list[Annotated[int, Field(ge=0, json_schema_extra={"minimum": 1})]],
        Field(min_length=2, max_length=2, description="[n, m]"),
    ]
    datatype: Literal["FP32"]
    parameters: InputParameters = InputParameters(binary_data_size=None)
    data: _Numbers | Annotated[list[_Numbers], Field(fail_fast=True)] | SkipJsonSchema[None] = Field(
        None, description="The numbers, row by row or flat; absent where bytes follow."
    )


class OutputParameters(_Message):
    """How an output is to come."""

    binary_data: bool | None = Field(None, strict=True, description="As bytes after the JSON.")


class RequestedOutput(_Message):
    """An output that is wanted."""

    name: OutputName
    parameters: OutputParameters = OutputParameters(binary_data=None)


class InferenceParameters(_Message):
    """What holds for the whole request."""

    binary_data_output: bool = Field(False, strict=True, description="All outputs as bytes, unless one says otherwise.")
    mesh: MeshChoice = Field(MeshChoice.FINE, description="Which mesh's vertices, where the model has a finer one.")
    bounds: BoundsField = Bounds.ALLOW
    quality: QualityField = Quality.FULL


class InferenceRequest(_Message):
    """A request to infer."""

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

    id: str | None = Field(None, description="Comes back in the answer.")
    inputs: Annotated[list[InputTensor], Field(min_length=1, max_length=1)]
    outputs: Annotated[list[RequestedOutput], Field(fail_fast=True, description="By default both; each once.")] = []
    parameters: InferenceParameters = InferenceParameters()

    @field_validator("outputs", mode="before")
    @classmethod
    def _each_once(cls, given: object) -> object:
        # Before they are looked at: there may be any number, and each would be computed.
        if isinstance(given, list):
            names = [output.get("name") for output in given[: len(OUTPUTS) + 1] if isinstance(output, dict)]
            for name in OUTPUTS:
                if names.count(name) > 1:
                    raise ProblemError("malformed-request", f"outputs names {name} twice. Name each output once.")
            if len(given) > len(OUTPUTS):
                raise ProblemError("malformed-request", f"outputs has {len(given)} entries. Name each output once.")
        return given

    @property
    def wanted(self) -> list[OutputName]:
        """Names of the outputs to give."""
        return [output.name for output in self.outputs] or list(OUTPUTS)

    def binary(self, name: str) -> bool:
        """Whether an output is to follow the JSON as bytes."""
        asked = [output.parameters.binary_data for output in self.outputs if output.name == name]
        return self.parameters.binary_data_output if not asked or asked[0] is None else asked[0]


class OutputTensor(BaseModel):
    """An output."""

    name: OutputName
    shape: list[int]
    datatype: Literal["FP32"]
    data: list[float] | None = Field(None, description="Flat, row by row; absent where bytes follow.")
    parameters: dict[str, int] | None = Field(None, description="`binary_data_size`, where bytes follow.")


class InferenceAnswer(BaseModel):
    """What was inferred."""

    model_name: str
    model_version: str
    id: str | None = None
    outputs: list[OutputTensor]


class TensorMetadata(BaseModel):
    """A tensor that goes in or comes out; −1 stands for any number."""

    name: str
    datatype: str
    shape: list[int]


class ModelMetadata(BaseModel):
    """A model as the protocol describes it."""

    name: str
    versions: list[str]
    platform: str
    inputs: list[TensorMetadata]
    outputs: list[TensorMetadata]


class ServerMetadata(BaseModel):
    """The server as the protocol describes it."""

    name: str
    version: str
    extensions: list[str]


class ModelReadiness(BaseModel):
    """Whether a model answers."""

    name: str
    ready: bool


def model_metadata(model: ShapeModel, versions: Sequence[str]) -> ModelMetadata:
    """A model's tensors."""
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


def parse(body: bytes, header: str | None) -> tuple[InferenceRequest, bytes]:
    """A body to the request, and the bytes that follow its JSON.

    Args:
        body: JSON, and after it the input's bytes if they aren't in it.
        header: value of HEADER, by default the length of the body.

    Raises:
        ProblemError: lengths that don't fit together.
        RequestValidationError: JSON that isn't a request.
    """
    length = len(body)
    if header is not None:
        if not re.fullmatch("[0-9]{1,12}", header) or int(header) > length:
            raise ProblemError(
                "malformed-request",
                f"{HEADER} is {header!r}, but the body has {length} bytes. Send the length of its JSON part.",
            )
        length = int(header)
    request = bodies.read(body[:length], InferenceRequest)
    tensor = request.inputs[0]
    size = tensor.parameters.binary_data_size
    if (size is None) == (tensor.data is None):
        raise _invalid(f"Send {INPUT} either as data, or with binary_data_size and its bytes after the JSON part")
    if len(body) - length != (size or 0):
        raise _invalid(
            f"{len(body) - length} bytes follow the JSON part, not {size or 0} as binary_data_size says. "
            f"Send {HEADER}, the length of the JSON part, and then the bytes of {INPUT}"
        )
    return request, body[length:]


def codes(request: InferenceRequest, tail: bytes) -> NDArray[np.floating]:
    """The codes (n, m) of a request, given the bytes that followed it; raises ProblemError."""
    tensor = request.inputs[0]
    n, m = tensor.shape
    if tensor.data is not None:
        rows = (row if isinstance(row, list) else [row] for row in tensor.data)
        values = np.array(list(chain.from_iterable(rows)), dtype=np.float64)
    elif len(tail) % _FLOAT.itemsize:
        raise _invalid(f"The bytes of {INPUT} are no whole number of FP32 values. Send {_FLOAT.itemsize} for each")
    else:
        values = np.frombuffer(tail, _FLOAT)
    if m == 0 or values.size != n * m:  # any number of codes without coordinates would fit
        raise _invalid(f"{INPUT} has {values.size} numbers, but its shape is {tensor.shape}. Send {n * m}")
    return values.reshape(n, m)


def _invalid(detail: str) -> ProblemError:
    return ProblemError("invalid-request", detail + ".")


def answer(
    request: InferenceRequest, model: ShapeModel, outputs: Mapping[str, NDArray[np.float32]]
) -> tuple[Iterator[Buffer], Mapping[str, int]]:
    """The body of an answer in pieces, and HEADER, the length of its JSON part, where bytes follow.

    Args:
        request: says how each output is to come.
        model: that inferred.
        outputs: those that are wanted.
    """
    text = _text(request, model, outputs)
    tail = [array.astype(_FLOAT, copy=False).data for name, array in outputs.items() if request.binary(name)]
    if not tail:
        return text, {}
    whole = b"".join(text)  # whose length comes first
    return chain([whole], (flat.cast("B") for flat in tail)), {HEADER: len(whole)}


def _text(request: InferenceRequest, model: ShapeModel, outputs: Mapping[str, NDArray[np.float32]]) -> Iterator[bytes]:
    facts = {"model_name": model.manifest.name, "model_version": model.manifest.version}
    yield dump_json(facts)[:-1] + b',"outputs":['
    for k, (name, array) in enumerate(outputs.items()):
        tensor: dict[str, object] = {"name": name, "shape": list(array.shape), "datatype": "FP32"}
        if request.binary(name):
            tensor["parameters"] = {"binary_data_size": _FLOAT.itemsize * array.size}
        yield (b"," if k else b"") + dump_json(tensor)[:-1]
        if not request.binary(name):
            for i, row in enumerate(array):  # a code at a time: all together may be large
                yield (b"," if i else b',"data":[') + dump_json(row.ravel())[1:-1]
            yield b"]"
        yield b"}"
    yield b"]" + (b',"id":' + dump_json(request.id) if request.id is not None else b"") + b"}"
