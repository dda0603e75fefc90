"""A check for schemathesis, loaded by schemathesis.toml."""

import schemathesis
from schemathesis import Case, CheckContext, Response

from shapespace.service.http.problems import KINDS

#: Problem types possible for requests that are valid by openapi.json.
BEYOND_SCHEMAS = {
    "no-tangent-space",
    "not-finite",  # beyond single precision
    "out-of-bounds",
    "path-too-long",
    "periodic",
    "too-many-codes",
    "too-many-frames",
    "wrong-length",
}


#: Further ones, by call, because parameters depend on each other or on the model: a header on the body's length,
#: a vertex number on the mesh, a file on its format, one time on another, a temperature on its distribution.
#: `{k}` is from a link template.
OF_CALLS = {
    "/interpolations": {"invalid-request"},
    "/{k}": {"invalid-request"},
    "/infer": {"invalid-request", "malformed-request"},
    "/edit": {"invalid-request"},
    "/sample": {"invalid-request"},
    "/fit": {kind for kind in KINDS if KINDS[kind].status in {400, 422}},
    "/encode": {kind for kind in KINDS if KINDS[kind].status in {400, 422}},
}


@schemathesis.check
def refusals_are_beyond_schemas(ctx: CheckContext, response: Response, case: Case) -> None:
    """A request that the schema allows is refused only for reasons that a schema can't express."""
    if case.meta and case.meta.generation.mode.is_positive and response.status_code in {400, 422}:
        kind = response.json()["type"].rpartition(":")[2]
        allowed = BEYOND_SCHEMAS | OF_CALLS.get(case.operation.path[case.operation.path.rindex("/") :], set())
        query, body = case.query or {}, case.body if isinstance(case.body, dict) else {}
        # `against` needs a colour; a spread needs a covariance and the reverse; a place is JSON in a string.
        # Not every format has polygons or frame times.
        if (
            "against" in query
            or "place" in query
            or query.get("color") == "spread"
            or query.get("topology") == "original"
            or "fps" in query
            or body.get("covariance") is not None
        ):
            allowed = allowed | {"invalid-request"}
        assert kind in allowed, f"{kind} refuses what the schema allows: {response.text}"
