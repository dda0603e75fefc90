"""A check for schemathesis, which loads it by schemathesis.toml."""

import schemathesis
from schemathesis import Case, CheckContext, Response

#: Kinds of problems that a request may have although it is as openapi.json says.
BEYOND_SCHEMAS = {
    "not-finite",  # beyond single precision
    "out-of-bounds",
    "path-too-long",
    "too-many-codes",
    "too-many-frames",
    "wrong-length",
}


@schemathesis.check
def refusals_are_beyond_schemas(ctx: CheckContext, response: Response, case: Case) -> None:
    """What the schema allows is refused only for what no schema can say."""
    if case.meta and case.meta.generation.mode.is_positive and response.status_code in {400, 422}:
        kind = response.json()["type"].rpartition(":")[2]
        lonely = "against" in (case.query or {}) and "color" not in case.query  # one parameter needs another
        framed = case.operation.path.endswith("/infer")  # and a header the body's length
        allowed = BEYOND_SCHEMAS | ({"invalid-request"} if lonely or framed else set())
        allowed |= {"malformed-request"} if framed else set()
        assert kind in allowed, f"{kind} refuses what the schema allows: {response.text}"
