"""How an emulated controller answers where the manuals leave a choice, and what can go wrong.

The manuals are silent or contradict observed behaviour in these places; a driver has to live with
every combination. Faults are mutable: a test or a demonstration turns them on during motion.
"""

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class Switches:
    """The open questions, one field each."""

    # "mixed": echoes end in the delimiter that was received, generated answers in CR.
    terminator: Literal["mixed", "cr", "lf", "crlf"] = "mixed"
    # What `J` answers during a run: 1 (manual) or +-222 (seen on hardware).
    run_answer: Literal["one", "222"] = "one"
    flash_answer_comma: bool = True
    hex_case: Literal["lower", "upper"] = "lower"
    own_echo: bool = False  # the adapter loops the host's bytes back
    m6_parks: bool = True
    while_unparking: Literal["wait", "refuse"] = "wait"  # a run that comes in those 80 ms
    overspeed: Literal["clamp", "refuse"] = "clamp"
    target_beyond_limit: Literal["stop_there", "refuse"] = "stop_there"
    broadcast_stop: bool = True
    # "lost": what the host says while a controller answers is lost, and so is the answer.
    collisions: Literal["ignored", "lost"] = "ignored"
    bare_status: bool = True  # `U` without a digit means `U0`
    encoder_type_description: bool = True  # `Y13:1, Quad_32`


@dataclass
class AxisFaults:
    """Faults of one motor and its controller. All live: set and unset at any time."""

    overheat: bool = False
    supply_lost: bool = False  # the 48 V supply is out of range
    encoder_frozen: bool = False
    encoder_error: bool = False
    stalled: bool = False  # the waveform runs, the rod stands
    limit_switch: bool = False  # both limit inputs are active: a broken common wire
    limit_forward: bool = False  # in2 is active
    limit_reverse: bool = False  # in1 is active
    limits_dead: bool = False  # the switches say nothing, wherever the stage is
    dead: bool = False  # no answer and no motion at all


@dataclass
class LineFaults:
    """Faults of the serial line, counted down or by chance."""

    drop_replies: int = 0
    garble_replies: int = 0
    truncate_replies: int = 0
    lose_commands: int = 0
    garble_commands: int = 0
    drop_probability: float = 0.0
    garble_probability: float = 0.0
    garble_command_probability: float = 0.0
    reply_delay_s: float = 0.0
    chatter: list[bytes] = field(default_factory=list)  # each is sent ahead of a reply
