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


@pytest.mark.parametrize(
    ("profile", "services"),
    [
        ("control", {"listener", "worker", "service"}),
        ("bridge", {"bridge"}),
        ("virtual", {"virtual-room"}),
    ],
)
def test_a_profile_starts_what_it_says_and_nothing_else(profile, services):
    started = {name for name, s in composed(profile).items() if profile in s.get("profiles", [])}
    always = {name for name, s in composed(profile).items() if not s.get("profiles")}
    assert started == services
    assert always == set()


def test_every_container_has_a_health_check_and_a_known_command():
    for name, service in composed("control", "virtual", "bridge").items():
        assert service["command"][0] in SUBCOMMANDS, name
        assert service["healthcheck"]["test"], name
