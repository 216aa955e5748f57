"""`[worker]`: localization and reconstruction."""

from pydantic import Field

from room_config.section import Section


class WorkerConfig(Section):
    poll_s: float = Field(
        default=0.005, gt=0, le=1, description="How often the record is checked for new work."
    )
    reconstruction_factor: int = Field(default=2, ge=2, le=4)
