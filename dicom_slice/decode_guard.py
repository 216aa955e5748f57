"""Decode compressed pixels in a child process: some codecs abort on damaged data.

A file whose decoder crashes or does not end is undecodable; the listener goes on. Uncompressed
pixels are decoded in this process.
"""

import json
import os
import resource
import selectors
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from dicom_slice.header import Slice, read_header
from dicom_slice.pixels import check_pixels, frame_digests
from dicom_slice.reasons import Reason, UnusableError

_MOST_MEMORY_BYTES = 2 * 2**30
_UNCOMPRESSED = (
    "",
    "1.2.840.10008.1.2",
    "1.2.840.10008.1.2.1",
    "1.2.840.10008.1.2.1.99",
    "1.2.840.10008.1.2.2",
)


class DecodeGuard:
    """Owns the child process, which is started when it is first needed, and again if it died."""

    def __init__(self, *, deadline_s: float = 15.0) -> None:
        self._deadline_s = deadline_s
        self._child: subprocess.Popen[bytes] | None = None

    def check(self, path: Path, slices: Sequence[Slice]) -> dict[int, UnusableError]:
        """As `pixels.check_pixels`: what is wrong with the pixels, by frame index."""
        if all(slice_.transfer_syntax_uid in _UNCOMPRESSED for slice_ in slices):
            return check_pixels(path, slices)
        answer = self._ask(str(path))
        if answer is None:
            crashed = UnusableError(Reason.UNDECODABLE, "the decoder crashed on the pixels")
            return {slice_.frame: crashed for slice_ in slices}
        if "all" in answer:
            raise UnusableError(Reason(answer["all"][0]), answer["all"][1])
        return {
            int(frame): UnusableError(Reason(code), text) for frame, (code, text) in answer.items()
        }

    def digests(self, path: Path) -> dict[int, str]:
        """As `pixels.frame_digests`, always in the child: who asks knows nothing of the file."""
        answer = self._ask([str(path)])
        if answer is None:
            raise UnusableError(Reason.UNDECODABLE, "the decoder crashed on the pixels")
        if "all" in answer:
            raise UnusableError(Reason(answer["all"][0]), answer["all"][1])
        return {int(frame): digest for frame, (digest,) in answer.items()}

    def close(self) -> None:
        if self._child is None:
            return
        self._child.kill()
        self._child.wait()
        for stream in (self._child.stdin, self._child.stdout):
            if stream is not None:
                stream.close()
        self._child = None

    def _ask(self, question: str | list[str]) -> dict[str, list[str]] | None:
        """The child's answer; None where it died over the question or did not answer in time."""
        child = self._running()
        assert child.stdin is not None
        assert child.stdout is not None
        try:
            child.stdin.write(json.dumps(question).encode() + b"\n")
            child.stdin.flush()
            with selectors.DefaultSelector() as selector:
                selector.register(child.stdout, selectors.EVENT_READ)
                line = child.stdout.readline() if selector.select(self._deadline_s) else b""
        except OSError:
            line = b""
        if not line.endswith(b"\n"):
            self.close()
            return None
        answer: dict[str, list[str]] = json.loads(line)
        return answer

    def _running(self) -> subprocess.Popen[bytes]:
        if self._child is not None and self._child.poll() is not None:
            self.close()
        if self._child is None:
            self._child = subprocess.Popen(
                [sys.executable, "-m", "dicom_slice.decode_guard"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                cwd=Path(__file__).parents[1],
                start_new_session=True,
            )
        return self._child


def _answer(question: str | list[str]) -> dict[str, list[str]]:
    """Of a path: what is wrong with its pixels; of a list with a path: digests of its frames."""
    try:
        if isinstance(question, list):
            return {str(frame): [d] for frame, d in frame_digests(Path(question[0])).items()}
        path = Path(question)
        problems = check_pixels(path, read_header(path))
    except UnusableError as error:
        return {"all": [error.reason.code, error.reason.text]}
    return {str(frame): [e.reason.code, e.reason.text] for frame, e in problems.items()}


def main() -> None:
    """The child: a question a line on standard input, one JSON object a line on standard output."""
    # a picture may say that it is larger than all the memory there is
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_MEMORY_BYTES, _MOST_MEMORY_BYTES))
    answers = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # codecs print; their words must not be taken for answers
    for line in sys.stdin.buffer:
        answers.write(json.dumps(_answer(json.loads(line))).encode() + b"\n")


if __name__ == "__main__":
    main()
