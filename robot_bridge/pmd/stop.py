"""After the bytes that stop everything: each axis has to confirm that it stands."""

from collections.abc import Callable, Iterable, Mapping, Sequence

from robot_bridge.pmd.axis import PmdAxis
from robot_bridge.pmd.line import PmdLine, Procedure, Task
from robot_bridge.pmd.protocol import PmdError

STOP_DEADLINE_S = 0.25
STOP_ANSWER_TIMEOUT_S = 0.06


def confirm_stops(
    axes: Sequence[PmdAxis],
    lines: Mapping[str, PmdLine],
    clock: Callable[[], float],
    *,
    timeout_s: float,
) -> list[str]:
    """Ask all axes on open lines, at most STOP_DEADLINE_S long. Returns what failed.

    `timeout_s`: of one answer, otherwise; here it is shorter.
    """
    deadline_s = clock() + STOP_DEADLINE_S
    for line in lines.values():
        line.timeout_s = min(timeout_s, STOP_ANSWER_TIMEOUT_S)
    within_reach = [axis for axis in axes if axis.config.controller in lines]
    tasks, failures = _run(within_reach, lines, _stop_stubbornly, lambda: clock() >= deadline_s)
    unconfirmed = [name for name, task in tasks.items() if not task.done or task.error]
    if not unconfirmed and not failures:
        # What is left of the time goes into where they stand now.
        _run(within_reach, lines, PmdAxis.read_position, lambda: clock() >= deadline_s)
    for line in lines.values():
        line.cancel_all()
        line.timeout_s = timeout_s
    return [*failures, *(f"axis {name} did not confirm the stop" for name in unconfirmed)]


def _run(
    axes: Sequence[PmdAxis],
    lines: Mapping[str, PmdLine],
    make: Callable[[PmdAxis], Procedure],
    is_late: Callable[[], bool],
) -> tuple[dict[str, Task], set[str]]:
    tasks = {
        axis.config.name: lines[axis.config.controller].start(make(axis), "stop") for axis in axes
    }
    failures: set[str] = set()
    while not all(task.done for task in tasks.values()) and not is_late():
        failures |= _step(lines.values())
    return tasks, failures


def _step(lines: Iterable[PmdLine]) -> set[str]:
    """Returns what failed; the axes on a line whose port fails confirm nothing."""
    failures = set()
    for line in lines:
        try:
            line.step(0.01)
        except OSError as error:
            line.cancel_all()
            failures.add(f"controller port: {error}")
    return failures


def _stop_stubbornly(axis: PmdAxis) -> Procedure:
    """Lost and damaged answers do not end it; the caller's deadline does."""
    while True:
        try:
            yield from axis.confirm_stop()
        except PmdError:
            continue
        return
