"""The settings (Y parameters) of an emulated controller: types, ranges, defaults, flash.

From the parameter table of the PMD401/PMD301 manuals, section 4.2.2. Values live in memory; some
survive a power cycle through the flash copy, the serial encoder types do not.
"""

from dataclasses import dataclass
from typing import Literal

Model = Literal["PMD401", "PMD301"]
I32 = (-(2**31), 2**31 - 1)
U8, U12, U16, U32 = (0, 255), (0, 4095), (0, 65535), (0, 2**32 - 1)

EXTERNAL_LIMIT, LIMIT_A, LIMIT_B, STOP_RANGE, ENCODER_DIRECTION = 2, 3, 4, 5, 6
MIN_SPEED, SPEED, RAMP_UP, RAMP_DOWN, STEPS_PER_COUNT = 7, 8, 9, 10, 11
SPEED_MODEL, ENCODER_TYPE, INDEX_OFFSET, ADDRESS, RESPONSE_DELAY = 12, 13, 14, 40, 44
HOST_ENCODER, QUADRATURE_ENCODER, SERVO_INPUT = 0, 1, 3
LAST_FLASH_ENCODER_TYPE = 3


@dataclass(frozen=True)
class Setting:
    name: str
    lowest: int
    highest: int
    pmd401_default: int
    pmd301_default: int
    in_flash: bool = True


SETTINGS = {
    EXTERNAL_LIMIT: Setting("xLimit", 0, 3, 0, 0),
    LIMIT_A: Setting("limit A", *I32, -10000, -10000),
    LIMIT_B: Setting("limit B", *I32, 10000, 10000),
    STOP_RANGE: Setting("stop range", *U16, 1, 1),
    ENCODER_DIRECTION: Setting("direction", 0, 1, 0, 0),
    MIN_SPEED: Setting("min speed", *U16, 1, 1),
    SPEED: Setting("speed", *U16, 1500, 2500),
    RAMP_UP: Setting("ramp up", 0, 800, 20, 20),
    RAMP_DOWN: Setting("ramp down", 0, 800, 20, 20),
    STEPS_PER_COUNT: Setting("SPC", *U32, 250, 250),
    SPEED_MODEL: Setting("model", *U8, 0, 0),
    ENCODER_TYPE: Setting("encoder", *U8, 1, 3),
    INDEX_OFFSET: Setting("index offset", *I32, 0, 0, in_flash=False),
    38: Setting("servo stop", *U12, 2047, 2047),
    39: Setting("servo range", *U12, 1, 1),
    ADDRESS: Setting("axis", 0, 126, 0, 0),
    RESPONSE_DELAY: Setting("response delay", *U8, 20, 20, in_flash=False),
}


COMPARED = (*range(LIMIT_A, SPEED_MODEL + 1), 38, 39)
RELOADED = (*COMPARED, ADDRESS)


class EmulatedSettings:
    """Memory and flash of one controller. Keys are the parameter numbers."""

    def __init__(self, model: Model, address: int) -> None:
        self._defaults = {
            n: s.pmd401_default if model == "PMD401" else s.pmd301_default
            for n, s in SETTINGS.items()
        }
        self.flash = {n: v for n, v in self._defaults.items() if SETTINGS[n].in_flash}
        self.flash[ADDRESS] = address
        self.memory: dict[int, int] = {}
        self.power_on()

    def __getitem__(self, number: int) -> int:
        return self.memory[number]

    def accepts(self, number: int, value: int) -> bool:
        return SETTINGS[number].lowest <= value <= SETTINGS[number].highest

    def store(self, number: int, value: int) -> None:
        self.memory[number] = value

    def power_on(self) -> None:
        self.memory = self._defaults | self.flash
        if self.memory[ENCODER_TYPE] > LAST_FLASH_ENCODER_TYPE:
            self.memory[ENCODER_TYPE] = HOST_ENCODER

    def reload(self) -> None:
        """`Y1,2`: less than a power-on brings back; Y2, Y13, Y14 and Y44 stay as they are."""
        self.memory |= {n: v for n, v in self.flash.items() if n in RELOADED}

    def save(self) -> None:
        self.flash = {n: v for n, v in self.memory.items() if SETTINGS[n].in_flash}

    def factory(self) -> None:
        self.memory |= {n: self._defaults[n] for n in range(3, 13)}

    def compare_flash(self) -> int:
        """0 equal, 1 differs, 2 the axis address differs."""
        if self.memory[ADDRESS] != self.flash[ADDRESS]:
            return 2
        return int(any(self.memory[n] != self.flash[n] for n in COMPARED))
