"""A sender made of pynetdicom takes no answer away from itself, however its threads are run."""

import time
from typing import Any

import pytest
from made_slices import mr_data_set
from pydicom.uid import ExplicitVRLittleEndian
from pynetdicom import AE, evt
from pynetdicom.association import Association
from pynetdicom.dimse import DIMSEServiceProvider

from dicom_listener.association_fix import mended
from dicom_slice.quirks import MR_IMAGE


class DawdlingAssociation(Association):
    """Put aside where it hurts, as on a busy machine.

    The reactor just after it has passed the checkpoint, the caller between question and answer.
    """

    _paused = False

    @property
    def _is_paused(self) -> bool:
        return self._paused

    @_is_paused.setter
    def _is_paused(self, paused: bool) -> None:
        if self._paused and not paused:
            time.sleep(0.05)
        self._paused = paused


class DawdlingMessages(DIMSEServiceProvider):
    def get_msg(self, block: bool = False) -> Any:
        if block:
            time.sleep(0.3)
        return super().get_msg(block)


@pytest.fixture
def receiver_port():
    ae = AE("AUTOSPINE")
    ae.add_supported_context(MR_IMAGE, [ExplicitVRLittleEndian])
    handlers: list[Any] = [(evt.EVT_C_STORE, lambda event: 0)]
    server = ae.start_server(("127.0.0.1", 0), block=False, evt_handlers=handlers)
    yield server.server_address[1]
    server.shutdown()


def associate(port: int, dimse_timeout_s: float) -> Association:
    ae = AE("SENDER")
    ae.dimse_timeout = dimse_timeout_s
    ae.add_requested_context(MR_IMAGE, [ExplicitVRLittleEndian])
    association = ae.associate("127.0.0.1", port, ae_title="AUTOSPINE")
    assert association.is_established
    association.__class__ = DawdlingAssociation
    association.dimse.__class__ = DawdlingMessages
    return association


def test_every_answer_reaches_the_caller_although_the_reactor_dawdles(receiver_port):
    association = mended(associate(receiver_port, 60.0))
    for number in range(5):
        assert association.send_c_store(mr_data_set(f"1.2.{number + 1}")).Status == 0
    association.release()
    assert association.is_released


def test_as_pynetdicom_comes_a_dawdling_reactor_takes_an_answer(receiver_port):
    """Should this fail one day, then pynetdicom has mended it, and `mended` can go."""
    association = associate(receiver_port, 2.0)
    for number in range(5):
        if "Status" not in association.send_c_store(mr_data_set(f"1.2.{number + 1}")):
            return
    pytest.fail("every answer was there")


def test_an_aborted_association_keeps_nobody_waiting(receiver_port):
    association = mended(associate(receiver_port, 60.0))
    association.abort()
    with pytest.raises(RuntimeError):
        association.send_c_store(mr_data_set())
    association.release()
