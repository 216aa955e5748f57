"""How the bridge stands, for its rules and for the service. Looks, and changes nothing."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from robot_bridge.daemon import rules
from robot_bridge.daemon.arming import Arming
from robot_bridge.daemon.bridge_journal import BridgeJournal
from robot_bridge.daemon.bridge_settings import BridgeSettings
from robot_bridge.daemon.declaring import Declaring
from robot_bridge.daemon.motion_in_flight import MotionInFlight
from robot_bridge.daemon.motor_watch import MotorWatch
from robot_bridge.daemon.whereabouts import Stand
from robot_bridge.protocol.framing import FrameCounters
from robot_bridge.protocol.messages import (
    PROTOCOL_VERSION,
    Code,
    Hello,
    Message,
    Status,
)
from robot_bridge.protocol.packing import SCHEMA


@dataclass(frozen=True, eq=False)
class BridgeView:
    settings: BridgeSettings
    boot_id: str
    permission: Arming
    motion: MotionInFlight
    motors: MotorWatch
    journal: BridgeJournal
    declaring: Declaring
    frames: FrameCounters
    refused: Counter[str]
    now_ms: Callable[[], int]  # since the bridge began

    @property
    def stale_after_ms(self) -> int:
        return round(self.settings.deadman_s * 1000)

    def standing(self, request: Message) -> rules.BridgeFacts:
        permission = self.permission
        command = self.motion.command
        return rules.BridgeFacts(
            phase=permission.phase,
            armed=permission.armed,
            stopped=permission.stopped,
            stop_reason=permission.stop_reason,
            stop_count=permission.stop_count,
            insertion_locked=self.journal.insertion_locked,
            in_flight=command.command_id if command else self._declaration,
            certain_axes=self.motion.certain_axes,
            readback_um=dict(self.motors.status.readback_um),
            whereabouts=self.motion.whereabouts,
            fault=self.motors.status.fault,
            last_motion=self.motion.last_motion,
            measurement_used=self.journal.measurement_used(
                getattr(request, "measurement_id", None)
            ),
            now_ms=self.now_ms(),
            stale_after_ms=self.stale_after_ms,
            axes=self.settings.axes,
        )

    @property
    def _declaration(self) -> str | None:
        return "declare" if self.declaring.under_way else None

    def status(self) -> Status:
        permission, motors, command = self.permission, self.motors.status, self.motion.last_command
        return Status(
            now_ms=self.now_ms(),
            boot_id=self.boot_id,
            phase=permission.phase.value,
            armed=permission.armed,
            stopped=permission.stopped,
            stop_reason=permission.stop_reason,
            stop_count=permission.stop_count,
            insertion_locked=self.journal.insertion_locked,
            moving=self.motion.command is not None or motors.moving,
            parked=motors.parked,
            positions_um=dict(motors.readback_um),
            position_certain=self.motion.certain,
            last_motion=self.motion.last_motion,
            fault=motors.fault,
            command_id=command.command_id if command else None,
            command_state=command.state.value if command else None,
            command_code=str(command.code) if command else "",
            command_text=command.text if command else "",
            command_readback_um=dict(command.readback_um) if command else {},
            frames_bad=self.frames.bad,
            refused=self.refused.total(),
            certain_axes=tuple(sorted(self.motion.certain_axes)),
            bound_um={axis: stand.bound_um for axis, stand in self._stands().items()},
            remembered_um={
                axis: stand.true_um
                for axis, stand in self._stands().items()
                if axis not in self.motion.certain_axes
            },
            correction_um={
                axis: stand.correction_um
                for axis, stand in self._stands().items()
                if axis in self.motion.certain_axes and stand.correction_um
            },
            motions=self.motion.motions,
            supply_mv={a: round(said["volts_48"] * 1000) for a, said in motors.supply.items()},
            board_celsius={a: round(said["board_celsius"]) for a, said in motors.supply.items()},
        )

    def _stands(self) -> Mapping[str, Stand]:
        return self.motion.whereabouts.stands

    def hello(self, nonce: int, session: int) -> Hello:
        return Hello(
            nonce=nonce,
            code=Code.OK,
            text="",
            protocol=PROTOCOL_VERSION,
            schema=SCHEMA,
            software=self.settings.software,
            session=session,
            boot_id=self.boot_id,
            now_ms=self.now_ms(),
            axes=self.settings.axes,
            position_certain=self.motion.certain,
            last_motion=self.motion.last_motion,
        )
