"""Adapters with emulated boards behind them, in virtual time: for campaigns of any length."""

from dataclasses import dataclass, field

from robot_bridge.emulator.bus import EmulatedBus


class Plug:
    """One adapter: a port with a bus behind it, which can be pulled out and put in elsewhere."""

    def __init__(self, line: "Line", bus: EmulatedBus) -> None:
        self.line, self.bus, self.out = line, bus, False

    def read(self, size: int = 1, /) -> bytes:
        self._must_be_in()
        heard = self.bus.take_output(self.line.now_s)
        if not heard:
            self.line.wait(0.002)
            heard = self.bus.take_output(self.line.now_s)
        return heard

    def write(self, data: bytes, /) -> int:
        self._must_be_in()
        self.bus.receive(data, self.line.now_s)
        return len(data)

    def reset_input_buffer(self) -> None:
        self._must_be_in()
        self.bus.take_output(self.line.now_s)

    def close(self) -> None:
        pass

    def _must_be_in(self) -> None:
        if self.out:
            raise OSError("the adapter is gone")


@dataclass
class Line:
    """All adapters and the time."""

    now_s: float = 1000.0
    plugs: dict[str, Plug] = field(default_factory=dict)

    def wait(self, seconds: float) -> None:
        self.now_s += seconds
        for plug in self.plugs.values():
            plug.bus.advance(self.now_s)

    def open_port(self, url: str) -> Plug:
        if self.plugs[url].out:
            raise OSError("no such device")
        return self.plugs[url]
