"""Long campaigns are marked `soak` and run only when they are asked for (`make soak`)."""

import pytest


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "soak: a long campaign; run with `make soak`")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.option.markexpr:
        return
    skip = pytest.mark.skip(reason="long campaign: run with `make soak`")
    for item in items:
        if item.get_closest_marker("soak"):
            item.add_marker(skip)
