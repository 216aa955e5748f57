"""Why an order is refused."""

from __future__ import annotations


class ConflictError(Exception):
    """Not now; the text says why and what to do. `code` is for programs."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code
