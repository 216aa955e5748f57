"""`[room]`: which room this is and where its cases lie."""

from pathlib import Path

from pydantic import Field, model_validator

from room_config.section import Section


class RoomConfig(Section):
    name: str = Field(min_length=1, description="Shown on the page and in reports.")
    cases_dir: Path | None = Field(
        default=None,
        description="Folder of the room's cases, relative to this file: each case is started and "
        "finished on the page and has its own folder here. Give either this or `case_dir`.",
    )
    case_dir: Path | None = Field(
        default=None,
        description="Folder of the only case of a room that has just one (a bench, a rehearsal); "
        "relative to this file.",
    )
    virtual: bool = Field(
        default=False, description="True: no patient, no robot; the page shows a banner."
    )

    @property
    def folders(self) -> tuple[Path | None, Path | None]:
        """cases_dir and case_dir, one of them None: what `case_record.cases.Cases` is made of."""
        return self.cases_dir, self.case_dir

    @model_validator(mode="after")
    def _one_of_two(self) -> "RoomConfig":
        if self.cases_dir is None and self.case_dir is None:
            raise ValueError("cases_dir is missing: the folder that holds the room's cases")
        if self.cases_dir is not None and self.case_dir is not None:
            raise ValueError("cases_dir and case_dir exclude each other: leave case_dir out")
        return self
