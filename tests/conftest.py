"""Which tests start processes: `make quick` leaves them out, and they run first, so that no worker
waits for the other's last long file. This folder is where every test finds `real_slices`.
"""

import os
import re
import sys
from functools import cache
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# How long an example takes says more about what else the machine is doing than about our code.
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

# Hundreds of processes start here: none compiles our modules anew, and none takes both cores for
# sums that one does as soon.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
os.environ.setdefault("OMP_NUM_THREADS", "1")

_FIXTURES = {"shared_room", "stages", "receiver", "start", "demo", "client", "browser", "page"}
_STARTS = re.compile(r"^\s*(?:import|from) (?:subprocess|playwright|multiprocessing)\b", re.M)
_IMPORTS = re.compile(r"^from (\w+) import|^import (\w+)$", re.M)


@cache
def _starts_processes(path: Path) -> bool:
    """Whether a module of the tests starts processes, by itself or by a helper beside it."""
    text = path.read_text()
    if _STARTS.search(text):
        return True
    helpers = {path.with_name(f"{a or b}.py") for a, b in _IMPORTS.findall(text)} - {path}
    return any(_starts_processes(helper) for helper in helpers if helper.is_file())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        fixtures = set(getattr(item, "fixturenames", ()))
        if fixtures & _FIXTURES or _starts_processes(item.path):
            item.add_marker("process")
    with_processes = {item.path for item in items if item.get_closest_marker("process")}
    items.sort(key=lambda item: item.path not in with_processes)
