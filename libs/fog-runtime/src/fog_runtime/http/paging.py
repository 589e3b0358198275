"""Pages of long lists: their size, and the address of the next one."""

from typing import Annotated
from urllib.parse import urlencode

from fastapi import Depends, Query


def _page_size(
    limit: Annotated[int, Query(description="The most entries of a page: at least 1 and at most 1000 count")] = 100,
) -> int:
    return max(1, min(limit, 1000))


PageSize = Annotated[int, Depends(_page_size)]
"""The parameter `limit`, brought into its bounds before it is passed on."""


def next_page(path: str, cursor: str | None, limit: int, **query: str | None) -> dict[str, str]:
    """Return the Link header with the next page's address; none without a cursor."""
    if cursor is None:
        return {}
    given = {**query, "cursor": cursor, "limit": limit}
    address = urlencode({name: value for name, value in given.items() if value is not None})
    return {"Link": f'<{path}?{address}>; rel="next"'}
