"""docker-compose.yml is valid by a compose implementation, and names every process."""

import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from service.cli.main import SUBCOMMANDS

ROOT = Path(__file__).parents[2]
COMPOSE = shutil.which("docker-compose")
pytestmark = pytest.mark.skipif(COMPOSE is None, reason="docker-compose is not installed")


def composed(*profiles: str) -> dict[str, dict]:
    """The services as the compose implementation understands them, by name."""
    words = [word for profile in profiles for word in ("--profile", profile)]
    result = subprocess.run(
        [COMPOSE, *words, "-f", ROOT / "docker-compose.yml", "config"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return yaml.safe_load(result.stdout)["services"]


def test_the_file_is_valid_and_has_one_service_a_process():
    always = {name for name, service in composed().items() if not service.get("profiles")}
    assert always == {"listener", "worker", "service"}


def test_bridge_and_virtual_room_are_profiles():
    profiles = {name: s.get("profiles") for name, s in composed("virtual", "bridge").items()}
    assert profiles["bridge"] == ["bridge"]
    assert profiles["virtual-room"] == ["virtual"]


def test_every_container_has_a_health_check_and_a_known_command():
    for name, service in composed("virtual", "bridge").items():
        assert service["command"][0] in SUBCOMMANDS, name
        assert service["healthcheck"]["test"], name
