"""The outbox: what is to be sent gets to every destination, whatever happens on the way."""

from pathlib import Path

import pydicom
from lone_service import running_service
from receivers import needs_program, storescp, wait_until
from recorded_case import make_case

DESTINATION = """
[[outputs.destination]]
name = "archive"
host = "127.0.0.1"
port = {port}
ae_title = "ARCHIVE"
"""


@needs_program("storescp")
def test_the_reconstruction_of_a_measurement_gets_from_the_service_to_an_archive(tmp_path: Path):
    make_case(tmp_path)
    stored = tmp_path / "archive"
    with storescp(stored) as port, running_service(tmp_path, DESTINATION.format(port=port)):
        wait_until(lambda: list(stored.glob("MR.*")))
    (path,) = stored.glob("MR.*")
    sent = pydicom.dcmread(tmp_path / "case" / "outputs" / "measurement-1-image.dcm")
    assert pydicom.dcmread(path).SOPInstanceUID == sent.SOPInstanceUID
