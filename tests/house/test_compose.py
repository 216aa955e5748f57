"""docker-compose.yml is valid by a compose implementation, and names every process."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
COMPOSE = shutil.which("docker-compose")


def services(*profiles: str) -> set[str]:
    words = [word for profile in profiles for word in ("--profile", profile)]
    result = subprocess.run(
        [COMPOSE, *words, "-f", ROOT / "docker-compose.yml", "config", "--services"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return set(result.stdout.split())


@pytest.mark.skipif(COMPOSE is None, reason="docker-compose is not installed")
def test_the_file_is_valid_and_has_one_service_a_process():
    assert services() >= {"listener", "worker", "service"}


@pytest.mark.skipif(COMPOSE is None, reason="docker-compose is not installed")
def test_the_virtual_room_is_a_profile():
    assert services("virtual") - services() >= {"virtual-room"}


@pytest.mark.skipif(COMPOSE is None, reason="docker-compose is not installed")
def test_every_container_has_a_health_check_and_only_known_commands():
    text = subprocess.run(
        [COMPOSE, "--profile", "virtual", "-f", ROOT / "docker-compose.yml", "config"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    from service.command_line import SUBCOMMANDS

    yaml = pytest.importorskip("yaml")
    composed = yaml.safe_load(text)["services"]
    for name, service in composed.items():
        command = service["command"]
        words = json.loads(json.dumps(command)) if isinstance(command, list) else command.split()
        assert words[0] in SUBCOMMANDS, name
        assert "healthcheck" in service, name
