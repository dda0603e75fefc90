"""A check for schemathesis, which loads it by schemathesis.toml."""

import schemathesis
from schemathesis import Case, CheckContext, Response

from shapespace.service.http.problems import KINDS

#: Kinds of problems that a request may have although it is as openapi.json says.
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


#: Further ones of calls whose parts depend on each other, or on the model: a header on the body's length, the number of
#: a vertex on the mesh, a file on its format, one time on another, a temperature on its distribution; `{k}` comes from
#: a link that is a template.
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
    """What the schema allows is refused only for what no schema can say."""
    if case.meta and case.meta.generation.mode.is_positive and response.status_code in {400, 422}:
        kind = response.json()["type"].rpartition(":")[2]
        allowed = BEYOND_SCHEMAS | OF_CALLS.get(case.operation.path[case.operation.path.rindex("/") :], set())
        query, body = case.query or {}, case.body if isinstance(case.body, dict) else {}
        # What compares needs a colour, a spread a covariance and the other way round; a place is JSON in a string.
        # Not every format has polygons, or tells how long a frame is shown.
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
