"""The page behind a real nginx or Caddy that ends TLS, in the ways in which people set them up."""

import os
import shutil
import socket
import ssl
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx
import pytest
import trustme
from lone_service import running_service
from playwright.sync_api import Browser, expect

from room_config.load import ConfigError, load_config
from room_config.networks import address_of, with_mapped
from service.client import RefusedByServiceError, RoomClient
from service.web.access import new_token, token_hash

NGINX = shutil.which("nginx", path="/usr/sbin:/usr/local/sbin:/usr/bin")
CADDY = shutil.which("caddy")
EXAMPLES = Path(__file__).parents[2] / "examples" / "proxy"
TOKEN = new_token()
TABLES = f"""
[[service.token]]
name = "Olga"
role = "operator"
sha256 = "{token_hash(TOKEN)}"
"""
pytestmark = pytest.mark.skipif(NGINX is None, reason="needs nginx")

# the headers that reach the service: nginx's defaults, and what people make of them
LOCATIONS = {
    "default headers": "location / { proxy_pass http://navigator; }",
    "the host without its port": (
        "location / { proxy_pass http://navigator; proxy_set_header Host $host; }"
    ),
    "a prefix that nginx strips": "location /rooms/a/ { proxy_pass http://navigator/; }",
    "a prefix that nginx leaves": "location /rooms/a/ { proxy_pass http://navigator; }",
}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Proxy:
    """nginx with a certificate for localhost; `ca` is the file of who signed it."""

    def __init__(self, folder: Path, prefix: str = "/") -> None:
        self.folder = folder
        self.port = free_port()
        self.url = f"https://localhost:{self.port}{prefix}"
        authority = trustme.CA()
        leaf = authority.issue_cert("localhost", "127.0.0.1")
        self.ca = folder / "ca.pem"
        authority.cert_pem.write_to_path(self.ca)
        leaf.private_key_pem.write_to_path(folder / "navigator.key")
        for k, blob in enumerate(leaf.cert_chain_pems):
            blob.write_to_path(folder / "navigator.crt", append=k > 0)

    def client(self) -> httpx.Client:
        verify = ssl.create_default_context(cafile=self.ca)
        return httpx.Client(verify=verify, base_url=self.url)

    def servers(self, upstream_port: int, location: str) -> str:
        return f"""
        upstream navigator {{ server 127.0.0.1:{upstream_port}; }}
        server {{ listen 127.0.0.1:{self.port} ssl;
            ssl_certificate {self.folder}/navigator.crt;
            ssl_certificate_key {self.folder}/navigator.key;
            {location} }}"""

    @contextmanager
    def running(self, servers: str) -> Iterator[None]:
        config = self.folder / "nginx.conf"
        scratch = "".join(
            f"{name}_temp_path {self.folder}/{name};\n"
            for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
        )
        config.write_text(
            f"daemon off; pid {self.folder}/pid; error_log {self.folder}/error.log;\n"
            f"events {{}}\nhttp {{ access_log off;\n{scratch}{servers} }}\n"
        )
        assert NGINX is not None
        process = subprocess.Popen([NGINX, "-c", str(config), "-e", str(self.folder / "error.log")])
        try:
            self._wait(process)
            yield
        finally:
            process.terminate()
            process.wait(20)

    @contextmanager
    def running_caddy(self) -> Iterator[None]:
        assert CADDY is not None
        words = [CADDY, "run", "--config", str(self.folder / "Caddyfile")]
        home = {"HOME": str(self.folder), "XDG_DATA_HOME": str(self.folder)}
        with (self.folder / "error.log").open("wb") as log:
            process = subprocess.Popen(words, env={**os.environ, **home}, stdout=log, stderr=log)
            try:
                self._wait(process)
                yield
            finally:
                process.terminate()
                process.wait(60)

    def _wait(self, process: subprocess.Popen[bytes]) -> None:
        deadline_s = time.monotonic() + 60
        while time.monotonic() < deadline_s:
            assert process.poll() is None, (self.folder / "error.log").read_text()
            try:
                socket.create_connection(("127.0.0.1", self.port), 5).close()
                return
            except OSError:
                time.sleep(0.02)
        raise AssertionError("the proxy does not listen")


def port_of(url: str) -> int:
    return int(url.rsplit(":", 1)[1])


@pytest.mark.parametrize("way", ["default headers", "a prefix that nginx strips"])
def test_a_browser_behind_nginx_logs_in_orders_follows_and_stops(
    way: str, browser: Browser, tmp_path: Path
) -> None:
    proxy = Proxy(tmp_path, "/rooms/a/" if "prefix" in way else "/")
    table = f'public_url = "{proxy.url}"\n' + TABLES
    with (
        running_service(tmp_path, table) as url,
        proxy.running(proxy.servers(port_of(url), LOCATIONS[way])),
        RoomClient(url, token=TOKEN) as inside,
    ):
        context = browser.new_context(ignore_https_errors=True)
        page = context.new_page()
        page.goto(proxy.url.rstrip("/") + "/")
        page.locator("#token").fill(TOKEN)
        page.get_by_role("button", name="Log in").click()
        expect(page.locator("#who")).to_contain_text("Olga")
        cookie = context.cookies()[0]
        assert cookie["secure"]
        assert cookie["path"] == proxy.url.removeprefix(f"https://localhost:{proxy.port}")
        inside.describe_case("told by the stream")  # comes in by the stream only
        expect(page.locator("#events")).to_contain_text("told by the stream")
        page.locator("#case-label").fill("ordered through nginx")
        page.locator("#card-case").get_by_role("button", name="Save").click()
        expect(page.locator("#events")).to_contain_text("ordered through nginx")
        page.locator("#stop").click()
        expect(page.locator("#events li", has_text="Stop").first).to_contain_text("Olga")
        context.close()


@pytest.mark.parametrize("way", ["the host without its port", "a prefix that nginx leaves"])
def test_a_program_behind_nginx_orders_follows_and_stops(way: str, tmp_path: Path) -> None:
    proxy = Proxy(tmp_path, "/rooms/a/" if "prefix" in way else "/")
    table = f'public_url = "{proxy.url}"\n' + TABLES
    with (
        running_service(tmp_path, table) as url,
        proxy.running(proxy.servers(port_of(url), LOCATIONS[way])),
    ):
        check_with_the_client(proxy)
        if "prefix" in way:  # the page's own addresses are relative: without the slash, nothing
            with proxy.client() as outside:
                bare = outside.get(proxy.url.rstrip("/"))
                who = {"Authorization": f"Bearer {TOKEN}"}
                first = outside.get("api/v1/events?limit=1", headers=who)
                onward = first.url.join(first.links["next"]["url"])
                assert outside.get(onward, headers=who).status_code == 200
            assert bare.headers["location"].endswith("/rooms/a/")


@pytest.mark.parametrize("way", ["default headers", "the host without its port"])
def test_where_public_url_was_forgotten_a_stop_and_browsers_of_today_get_through(
    way: str, tmp_path: Path
) -> None:
    proxy = Proxy(tmp_path)
    with (
        running_service(tmp_path, TABLES) as url,
        proxy.running(proxy.servers(port_of(url), LOCATIONS[way])),
        httpx.Client(
            verify=ssl.create_default_context(cafile=proxy.ca), base_url=proxy.url
        ) as outside,
    ):
        same = {"Sec-Fetch-Site": "same-origin", "Origin": proxy.url.rstrip("/")}
        logged_in = outside.post("api/v1/session", json={"token": TOKEN}, headers=same)
        assert logged_in.status_code == 200, logged_in.text
        old_browser = {"Origin": proxy.url.rstrip("/")}
        assert outside.post("api/v1/stop", headers=old_browser).status_code == 202
        foreign = {"Origin": "https://evil.example", "Sec-Fetch-Site": "cross-site"}
        refused = outside.post("api/v1/stop", headers=foreign)
        assert refused.status_code == 403
        assert "evil.example" in refused.json()["detail"]


@pytest.mark.parametrize("prefix", ["/", "/navigator/"])
def test_the_example_files_work_as_they_are(prefix: str, tmp_path: Path) -> None:
    proxy = Proxy(tmp_path, prefix)
    with running_service(tmp_path, f'public_url = "{proxy.url}"\n' + TABLES) as url:
        shutil.copy(EXAMPLES / "navigator_headers.conf", tmp_path)
        servers = (EXAMPLES / "nginx.conf").read_text()
        for ours, here in (
            ("127.0.0.1:8080", f"127.0.0.1:{port_of(url)}"),
            ("listen 443 ssl", f"listen 127.0.0.1:{proxy.port} ssl"),
            ("/etc/nginx", str(tmp_path)),
        ):
            assert ours in servers
            servers = servers.replace(ours, here)
        with proxy.running(servers):
            check_with_the_client(proxy)


@pytest.mark.skipif(CADDY is None, reason="needs Caddy")
@pytest.mark.parametrize("prefix", ["/", "/navigator/"])
def test_the_example_file_of_caddy_works_as_it_is(prefix: str, tmp_path: Path) -> None:
    proxy = Proxy(tmp_path, prefix)
    name = "rooms.example.org" if "navigator" in prefix else "navigator.example.org"
    with running_service(tmp_path, f'public_url = "{proxy.url}"\n' + TABLES) as url:
        text = (EXAMPLES / "Caddyfile").read_text()
        tls = f"tls {tmp_path}/navigator.crt {tmp_path}/navigator.key"
        assert f"{name} {{" in text
        text = text.replace("127.0.0.1:8080", f"127.0.0.1:{port_of(url)}")
        # what belongs to the place: its name and port, and the certificate
        text = text.replace(f"{name} {{", f"https://localhost:{proxy.port} {{\n\t{tls}\n")
        other = ({"rooms.example.org", "navigator.example.org"} - {name}).pop()
        text = text.replace(f"{other} {{", f"http://{other}:{free_port()} {{")
        here = "{\n\tadmin off\n\tauto_https disable_redirects\n\tdefault_bind 127.0.0.1\n}\n"
        (tmp_path / "Caddyfile").write_text(here + text)
        with proxy.running_caddy():
            check_with_the_client(proxy)


def check_with_the_client(proxy: Proxy) -> None:
    with RoomClient(proxy.url, token=TOKEN, ca=proxy.ca) as client:
        assert client.session().name == "Olga"
        client.describe_case("by the client")
        kinds = []
        for message in client.live():
            kinds.append(message.body.get("kind", message.kind))
            if "case_described" in kinds:
                break
        client.stop()
        deadline_s = time.monotonic() + 120
        while "stop" not in kinds:
            assert time.monotonic() < deadline_s
            with suppress(RefusedByServiceError):  # it could not be read in time: a busy machine
                kinds = [event.kind for event in client.events()]


def test_wrong_tokens_lock_out_one_address_not_everybody_behind_the_proxy(tmp_path: Path) -> None:
    headers = "proxy_set_header X-Forwarded-For $http_x_trial_address;"
    location = f"location / {{ proxy_pass http://navigator; {headers} }}"
    proxy = Proxy(tmp_path)
    table = f'public_url = "{proxy.url}"\nlock_out_after = 2\n' + TABLES
    with (
        running_service(tmp_path, table) as url,
        proxy.running(proxy.servers(port_of(url), location)),
        httpx.Client(
            verify=ssl.create_default_context(cafile=proxy.ca), base_url=proxy.url
        ) as outside,
    ):

        def ask(address: str, token: str) -> int:
            headers = {"X-Trial-Address": address, "Authorization": f"Bearer {token}"}
            return outside.get("api/v1/state", headers=headers).status_code

        assert [ask("192.0.2.7", "wrong") for _ in range(3)] == [401, 401, 429]
        # the same caller as a dual-stack proxy writes it
        assert ask("::ffff:192.0.2.7", TOKEN) == 429
        assert ask("192.0.2.8", TOKEN) == 200


def test_a_page_of_another_port_is_refused_and_both_addresses_are_named(tmp_path: Path) -> None:
    with running_service(tmp_path) as url:
        other = {"Origin": "http://127.0.0.1:1"}
        refused = httpx.put(f"{url}/api/v1/case", json={"label": "x"}, headers=other)
        assert refused.status_code == 403
        assert "http://127.0.0.1:1" in refused.json()["detail"]
        assert url.removeprefix("http://") in refused.json()["detail"]
        # a page that cannot order can do no harm by stopping; a person's STOP may look like that
        assert httpx.post(f"{url}/api/v1/stop", headers=other).status_code == 202


def test_what_others_reach_needs_tokens(tmp_path: Path) -> None:
    config = tmp_path / "room.toml"
    text = '[room]\nname = "x"\ncase_dir = "case"\n[service]\nbridge_link = "/dev/null"\n'
    for value, said in (
        ("https://navigator.example.org/", "token"),
        ("navigator.example.org", "not an address"),
        ("https://x.example/?a=b", "path only"),
    ):
        config.write_text(f'{text}public_url = "{value}"\n')
        with pytest.raises(ConfigError, match=said):
            load_config(config)
    config.write_text(f'{text}public_url = "https://localhost:8443/room"\n')
    assert load_config(config).service.public_url == "https://localhost:8443/room/"


def test_an_ipv4_caller_of_a_dual_stack_socket_is_an_ipv4_caller() -> None:
    assert str(address_of("::ffff:192.0.2.7")) == "192.0.2.7"
    assert str(address_of("2001:db8::7")) == "2001:db8::7"
    assert with_mapped(["10.0.0.0/8"]) == ["10.0.0.0/8", "::ffff:10.0.0.0/104"]
