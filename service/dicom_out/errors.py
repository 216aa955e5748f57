"""What keeps an output from being made."""

from room_config.exit_codes import BAD_INPUT


class OutputError(ValueError):
    """The output cannot be made from what is there; one line."""

    exit_code = BAD_INPUT
