"""Bodies of the Open Inference Protocol: JSON, and the extension in which tensors follow it as bytes.

Bytes are little-endian FP32 in row-major order.
https://github.com/triton-inference-server/server/blob/main/docs/protocol/extension_binary_data.md
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from shapespace.files.archives import Buffer
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.messages import bodies
from shapespace.service.http.messages.open_inference import INPUT, InferenceRequest
from shapespace.service.refusals import RefusedError
from shapespace.service.use_cases.shape_formats import dump_json

#: Header with the length of the JSON part of a body that continues with bytes.
HEADER = "Inference-Header-Content-Length"
_FLOAT = np.dtype("<f4")
#: Most lengths of rows that a message names.
_NAMED = 3


def read_request(body: bytes, header: str | None) -> tuple[InferenceRequest, bytes]:
    """Return the request in a body, whose JSON is as long as HEADER says, and the bytes of the input after it.

    Raises:
        RefusedError: the lengths contradict each other.
        RequestValidationError: the JSON is no valid request.
    """
    length = len(body)
    if header is not None:
        if not re.fullmatch("[0-9]{1,12}", header) or int(header) > length:
            raise RefusedError(
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


def read_codes(request: InferenceRequest, tail: bytes) -> NDArray[np.floating]:
    """Return the codes (n, m) of a request, given the bytes after it; raises RefusedError."""
    tensor = request.inputs[0]
    n, m = tensor.shape
    if tensor.data is not None:
        rows = [row for row in tensor.data if isinstance(row, list)]
        if rows and (len(rows) != n or any(len(row) != m for row in rows)):
            lengths = ", ".join(map(str, sorted({len(row) for row in rows})[:_NAMED]))
            told = f"data has {len(rows)} rows of {lengths} numbers, but the shape of {INPUT} is {tensor.shape}"
            raise _invalid(f"{told}. Send {n} rows of {m}, or all numbers in one list")
        values = np.array(list(chain.from_iterable(rows)) if rows else tensor.data, dtype=np.float64)
    elif len(tail) % _FLOAT.itemsize:
        raise _invalid(f"The bytes of {INPUT} are no whole number of FP32 values. Send {_FLOAT.itemsize} for each")
    else:
        values = np.frombuffer(tail, _FLOAT)
    if m == 0 or values.size != n * m:  # m = 0 would fit any number of codes
        raise _invalid(f"{INPUT} has {values.size} numbers, but its shape is {tensor.shape}. Send {n * m}")
    return values.reshape(n, m)


def _invalid(detail: str) -> RefusedError:
    return RefusedError("invalid-request", detail + ".")


def write_answer(
    request: InferenceRequest, model: ShapeModel, outputs: Mapping[str, NDArray[np.float32]]
) -> tuple[Iterator[Buffer], Mapping[str, int]]:
    """Return the body of an answer in pieces, and HEADER with the length of its JSON part if bytes follow."""
    text = _json(request, model, outputs)
    tail = [array.astype(_FLOAT, copy=False).data for name, array in outputs.items() if request.binary(name)]
    if not tail:
        return text, {}
    whole = b"".join(text)  # its length is a header, sent before it
    return chain([whole], (flat.cast("B") for flat in tail)), {HEADER: len(whole)}


def _json(request: InferenceRequest, model: ShapeModel, outputs: Mapping[str, NDArray[np.float32]]) -> Iterator[bytes]:
    facts = {"model_name": model.manifest.name, "model_version": model.manifest.version}
    yield dump_json(facts)[:-1] + b',"outputs":['
    for k, (name, array) in enumerate(outputs.items()):
        tensor: dict[str, object] = {"name": name, "shape": list(array.shape), "datatype": "FP32"}
        if request.binary(name):
            tensor["parameters"] = {"binary_data_size": _FLOAT.itemsize * array.size}
        yield (b"," if k else b"") + dump_json(tensor)[:-1]
        if not request.binary(name):
            for i, row in enumerate(array):  # one code at a time, as all together may be large
                yield (b"," if i else b',"data":[') + dump_json(row.ravel())[1:-1]
            yield b"]"
        yield b"}"
    yield b"]" + (b',"id":' + dump_json(request.id) if request.id is not None else b"") + b"}"
