"""`autospine camera`: a camera over the robot in the place of the scanner."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from bench.config import BenchRoom, CameraConfigError, CameraError, load_bench
from bench.operator import operate_bench
from bench.optics import learn_lens
from bench.preview import Preview
from bench.slices import BenchCamera
from bench.source import FrameSource, picture_files, read_picture
from room_config.exit_codes import DONE
from simulator.command_line import note_as, stop_event
from simulator.scan_operator import TOKEN_VARIABLE

_GOOD_BOARDS = 6
app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def camera(
    config: Annotated[
        Path | None, typer.Option(help="The room's TOML file, with a table for the camera.")
    ] = None,
    board: Annotated[
        str,
        typer.Option(help="Pictures of a checkerboard (pattern or folder), to calibrate the lens."),
    ] = "",
    squares: Annotated[str, typer.Option(help="Squares on the board: ROWSxCOLUMNS.")] = "8x11",
    square_mm: Annotated[
        float | None, typer.Option(help="Side length of a square; the scale rests on it.", min=0.1)
    ] = None,
    out: Annotated[Path, typer.Option(help="The lens file to write.")] = Path("lens.json"),
    exit_with_parent: Annotated[
        bool, typer.Option(help="Exit when standard input is closed.")
    ] = False,
) -> int:
    """Slices from a camera: acquires what the service asks for and sends it by C-STORE.

    With --board it learns lens and scale from pictures of a checkerboard instead; the first one
    lies flat where the circle will be.
    """
    if board:
        if square_mm is None:
            raise CameraConfigError("--board needs --square-mm: the scale rests on it")
        return _learn(board, squares, square_mm, out)
    if config is None:
        raise CameraConfigError("give --config ROOM.toml, or --board PICTURES")
    room = load_bench(config)
    settings = room.camera
    stop = stop_event(exit_with_parent)
    note = note_as("camera")
    source = FrameSource(settings.source, latency_s=settings.latency_s, stall_s=settings.stall_s)
    try:
        _acquire(room, source, stop, note)
    except CameraError as error:
        if source.hangs:
            print(f"autospine: {error}", file=sys.stderr, flush=True)
            os._exit(error.exit_code)
        raise
    if source.hangs:
        os._exit(DONE)
    return DONE


def _acquire(
    room: BenchRoom, source: FrameSource, stop: threading.Event, note: Callable[[str], None]
) -> None:
    bench_camera, settings = BenchCamera(room), room.camera
    with source, contextlib.ExitStack() as at_end:
        bench_camera.slice_of([source.next_after(0)])  # scale and field are checked now
        facts: dict[str, object] = {"ready": "camera"}
        if settings.preview_port is not None:
            preview = Preview(settings.preview_port, bench_camera, source)
            at_end.callback(preview.close)
            facts["preview"] = preview.url
        operate_bench(
            room,
            bench_camera,
            source,
            stop,
            note,
            _token(room),
            lambda: print(json.dumps(facts), flush=True),
        )


def _learn(board: str, squares: str, square_mm: float, out: Path) -> int:
    try:
        rows, cols = (int(number) for number in squares.lower().split("x"))
    except ValueError:
        raise CameraConfigError(
            f"--squares {squares}: expected ROWSxCOLUMNS, such as 8x11"
        ) from None
    if min(rows, cols) < 3 or rows == cols:
        raise CameraConfigError(
            f"--squares {squares}: at least 3 each way, and the two must differ"
        )
    if out.exists():
        raise CameraConfigError(f"--out {out}: exists; move it away first, or name another file")
    files = picture_files(board)
    if not files:
        raise CameraConfigError(f"--board {board}: no pictures found")
    lens = learn_lens([read_picture(file) for file in files], (rows, cols), square_mm)
    out.write_text(json.dumps(lens.to_json(), indent=1) + "\n", encoding="utf-8")
    print(
        f"{out}: {lens.px_per_mm:.4f} px/mm; the board's corners fit to within "
        f"{lens.residual_px:.2f} px ({len(files)} picture{'s' if len(files) != 1 else ''})"
    )
    if len(files) < _GOOD_BOARDS:
        print(f"{_GOOD_BOARDS} or more, held at different tilts, tell the lens better")
    return DONE


def _token(room: BenchRoom) -> str:
    """The token for the service, or '' where none is needed."""
    if os.environ.get(TOKEN_VARIABLE):
        return os.environ[TOKEN_VARIABLE].strip()
    if not room.camera.token_file:
        return ""
    path = room.folder / room.camera.token_file
    try:
        return path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        raise CameraConfigError(f"camera.token_file: {path} cannot be read") from None
