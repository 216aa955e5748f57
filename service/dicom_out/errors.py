"""What keeps an output from being made."""


class OutputError(ValueError):
    """The output cannot be made from what is there; one line."""

    exit_code = 2
