"""`[room]`: which room this is and where its case lies."""

from pathlib import Path

from pydantic import Field

from room_config.section import Section


class RoomConfig(Section):
    name: str = Field(min_length=1, description="Shown on the page and in reports.")
    case_dir: Path = Field(description="Folder of the case record; relative to this file.")
    virtual: bool = Field(
        default=False, description="True: no patient, no robot; the page shows a banner."
    )
