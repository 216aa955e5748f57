"""What many routes have in common: ids, pages, and the errors of questions."""

from __future__ import annotations

from typing import Annotated

from fastapi import Path as PathParameter
from fastapi import Query, Request, Response

from service.web.problems import responses

MOST_ID = 2**53
Id = Annotated[int, PathParameter(ge=1, le=MOST_ID)]
After = Annotated[
    int, Query(ge=0, le=MOST_ID, description="Start after this id (before it with `newest`).")
]
Limit = Annotated[int, Query(ge=1, le=1000)]
Newest = Annotated[bool, Query(description="Newest first instead of oldest first.")]
ERRORS = responses(401, 404, 409, 422, 429)  # of no such case, of none that is open
ERRORS_WITH_ID = ERRORS


def link_onward(request: Request, response: Response, ids: list[int], limit: int) -> None:
    """Name the next page in the `Link` header, if this one is full."""
    if len(ids) == limit:
        onward = request.url.include_query_params(after=ids[-1])
        path = f"{request.state.prefix}{onward.path}"
        response.headers["Link"] = f'<{path}?{onward.query}>; rel="next"'
