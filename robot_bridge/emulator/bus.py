"""Several emulated controllers on one serial bus: bytes in, bytes out, faults of the line.

No I/O and no clock of its own: `receive(data, now_s)` and `advance(now_s)` are told the time,
`take_output(now_s)` gives what is due by then.
"""

import heapq
import random
import re
from collections.abc import Sequence

from robot_bridge.emulator import settings as y
from robot_bridge.emulator.axis import EmulatedController
from robot_bridge.emulator.commands import Answer, execute, failed, status_error
from robot_bridge.emulator.switches import LineFaults, Switches
from robot_bridge.pmd.protocol import BROADCAST_ADDRESS
from robot_bridge.pmd.status import Status

BYTE_S = 10 / 115200  # start bit, eight data bits, stop bit
PARTIAL_LINE_TIMEOUT_S = 0.3
PING_SPACING_S = 0.002
ESC, CR, LF, SEMICOLON = 0x1B, 0x0D, 0x0A, 0x3B
MAX_LINE_BYTES = 256


class EmulatedBus:
    """The controllers see every byte; each answers to its own address."""

    def __init__(
        self,
        controllers: Sequence[EmulatedController],
        switches: Switches,
        rng: random.Random,
    ) -> None:
        self.controllers = list(controllers)
        self.switches = switches
        self.faults = LineFaults()
        self.lines_received = 0
        self.collisions = 0
        self._rng = rng
        self._line = bytearray()
        self._cancelled = False
        self._last_byte_s = 0.0
        self._line_free_s = 0.0
        self._outbox: list[tuple[float, int, float, bytes]] = []  # ends, number, begins, bytes
        self._sent = 0

    def set_switches(self, switches: Switches) -> None:
        """Answer the open questions in another way from now on."""
        self.switches = switches
        for controller in self.controllers:
            controller.switches = switches

    # Time

    def advance(self, now_s: float) -> None:
        if self._line and now_s - self._last_byte_s > PARTIAL_LINE_TIMEOUT_S:
            self._abandon_line()
        for controller in self.controllers:
            controller.advance(now_s)

    def _abandon_line(self) -> None:
        self._line.clear()
        self._cancelled = False
        for controller in self.controllers:
            status_error(controller)

    @property
    def busy(self) -> bool:
        """Whether `advance` has to be called again soon."""
        return bool(self._outbox or self._line) or any(c.busy for c in self.controllers)

    def take_output(self, now_s: float) -> bytes:
        due = bytearray()
        while self._outbox and self._outbox[0][0] <= now_s:
            due += heapq.heappop(self._outbox)[3]
        return bytes(due)

    def next_output_s(self) -> float | None:
        return self._outbox[0][0] if self._outbox else None

    # Bytes in

    def receive(self, data: bytes, now_s: float) -> None:
        self.advance(now_s)
        if self.switches.collisions == "lost" and self._collides(now_s):
            return
        if self.switches.own_echo:
            self._send(data, now_s)
        self._last_byte_s = now_s
        for byte in data:
            self._receive_byte(byte, now_s)

    def _collides(self, now_s: float) -> bool:
        """Half duplex: two talk at once, and nobody is understood."""
        answering = any(begins_s <= now_s < ends_s for ends_s, _, begins_s, _ in self._outbox)
        if answering:
            self.collisions += 1
            self._outbox.clear()
            for controller in self.controllers:
                controller.latched |= Status.COM_ERROR
        return answering

    def _receive_byte(self, byte: int, now_s: float) -> None:
        if byte in (CR, LF, SEMICOLON):
            line, cancelled = bytes(self._line), self._cancelled
            self._line.clear()
            self._cancelled = False
            if line and not cancelled:
                self._receive_line(line, byte, now_s)
        elif byte == ESC:
            self._cancelled = True
        elif len(self._line) < MAX_LINE_BYTES:
            self._line.append(byte)

    def _receive_line(self, line: bytes, delimiter: int, now_s: float) -> None:
        self.lines_received += 1
        if self.faults.lose_commands > 0:
            self.faults.lose_commands -= 1
            return
        if self.faults.garble_commands > 0 or (
            self._rng.random() < self.faults.garble_command_probability
        ):
            self.faults.garble_commands = max(0, self.faults.garble_commands - 1)
            line = self._with_wrong_bit(line)
        matched = re.fullmatch(rb"X(\d{0,3})(~?)([\x20-\x7e]*)", line)
        if not matched:  # another device's chatter, or a line that lacks its X
            if delimiter == SEMICOLON:
                for controller in self.controllers:
                    status_error(controller)
            return
        address = int(matched[1] or b"0")
        shown = f"X{matched[1].decode()}"
        body = matched[3].decode()
        if address == BROADCAST_ADDRESS:
            self._broadcast(body, delimiter, now_s)
        elif matched[2]:
            self._chain(address + 1, body, delimiter, now_s)
        else:
            self._single(address, shown, body, delimiter, now_s)

    def _at(self, address: int) -> EmulatedController | None:
        for controller in self.controllers:
            if controller.address == address and not controller.deaf:
                return controller
        return None

    def _single(self, address: int, shown: str, body: str, delimiter: int, now_s: float) -> None:
        controller = self._at(address)
        if controller is None:
            return
        delay_s = controller.settings[y.RESPONSE_DELAY] * 1e-6
        answer = execute(controller, body)
        if delimiter == SEMICOLON:
            if failed(answer):
                status_error(controller)
        else:
            self._reply(shown, answer, delimiter, now_s + delay_s)

    def _broadcast(self, body: str, delimiter: int, now_s: float) -> None:
        for controller in [c for c in self.controllers if not c.deaf]:
            if not body:
                if delimiter != SEMICOLON:
                    at_s = now_s + controller.address * PING_SPACING_S
                    self._reply(f"X{controller.address}", Answer("", False), delimiter, at_s)
            elif body.startswith("S") and not self.switches.broadcast_stop:
                continue
            elif failed(execute(controller, body)):
                status_error(controller)

    def _chain(self, address: int, body: str, delimiter: int, now_s: float) -> None:
        """`X0~U`: axis 1 answers, which makes axis 2 answer, and so on without a gap."""
        while (controller := self._at(address)) is not None:
            answer = execute(controller, body)
            broken = failed(answer)
            mark = "" if broken else "~"
            if delimiter != SEMICOLON:
                chained = Answer(mark + answer.text, answer.generated)
                self._reply(f"X{address}", chained, delimiter, now_s)
            if broken:
                return
            address += 1

    # Bytes out

    def _reply(self, shown: str, answer: Answer, delimiter: int, at_s: float) -> None:
        raw = (shown + answer.text).encode("ascii") + self._terminator(answer, delimiter)
        for chatter in self.faults.chatter:
            self._send(chatter, at_s)
        damaged = self._damage(raw)
        if damaged:
            self._send(damaged, at_s + self.faults.reply_delay_s)

    def _terminator(self, answer: Answer, delimiter: int) -> bytes:
        fixed = {"cr": b"\r", "lf": b"\n", "crlf": b"\r\n"}
        if self.switches.terminator in fixed:
            return fixed[self.switches.terminator]
        return b"\r" if answer.generated else bytes([delimiter])

    def _damage(self, raw: bytes) -> bytes:
        faults, chance = self.faults, self._rng.random
        if faults.drop_replies > 0 or chance() < faults.drop_probability:
            faults.drop_replies = max(0, faults.drop_replies - 1)
            return b""
        if faults.truncate_replies > 0:
            faults.truncate_replies -= 1
            return raw[: len(raw) // 2]
        if faults.garble_replies > 0 or chance() < faults.garble_probability:
            faults.garble_replies = max(0, faults.garble_replies - 1)
            return self._with_wrong_bit(raw)
        return raw

    def _with_wrong_bit(self, raw: bytes) -> bytes:
        place = self._rng.randrange(len(raw))
        wrong = raw[place] ^ (1 << self._rng.randrange(8))
        return raw[:place] + bytes([wrong]) + raw[place + 1 :]

    def _send(self, data: bytes, not_before_s: float) -> None:
        begins_s = max(not_before_s, self._line_free_s)
        self._line_free_s = begins_s + len(data) * BYTE_S
        self._sent += 1
        heapq.heappush(self._outbox, (self._line_free_s, self._sent, begins_s, data))
