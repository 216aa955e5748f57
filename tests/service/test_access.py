"""Who may do what: tokens, roles, cookies, lock-out, origins, headers, on the real service."""

import ssl
import subprocess
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import trustme
from lone_service import CONFIG, running_service

from room_config.service import AccessToken
from room_config.shell import autospine
from service.web.access import Access, AccessRules, LockedOutError, new_token, token_hash
from simulator.config import ScannerSettings, VirtualRoomError
from simulator.scan_operator import read_token

OPERATOR, VIEWER, EXPIRED = new_token(), new_token(), new_token()
TOKENS = f"""
lock_out_after = 3
lock_out_s = 5.0

[[service.token]]
name = "Olga"
role = "operator"
sha256 = "{token_hash(OPERATOR)}"

[[service.token]]
name = "Victor"
role = "viewer"
sha256 = "{token_hash(VIEWER)}"

[[service.token]]
name = "Eve"
role = "operator"
sha256 = "{token_hash(EXPIRED)}"
expires = 2020-01-01
"""


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with running_service(tmp_path_factory.mktemp("guarded"), TOKENS) as address:
        yield address


@pytest.fixture(scope="module")
def open_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with running_service(tmp_path_factory.mktemp("open")) as address:
        yield address


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def check_problem(answer: httpx.Response, status: int, code: str) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    body: dict[str, Any] = answer.json()
    assert (body["title"], body["status"]) == (code, status)
    assert body["type"] == f"urn:autospine:{code}"
    assert len(body["detail"]) > 10
    return body


def operations(url: str) -> list[tuple[str, str]]:
    """Every (method, path) of the API, ids filled in."""
    paths = httpx.get(f"{url}/api/v1/openapi.json", headers=bearer(VIEWER)).json()["paths"]
    found = [(m.upper(), p) for p, methods in paths.items() for m in methods]
    return [(m, p.replace("{slice_id}", "1").replace("{measurement_id}", "1")) for m, p in found]


def test_off_loopback_without_tokens_the_service_refuses_to_start(tmp_path: Path) -> None:
    config = tmp_path / "room.toml"
    config.write_text(CONFIG + 'host = "0.0.0.0"\n')
    ended = subprocess.run(
        autospine("service", "--config", str(config)), capture_output=True, text=True, timeout=60
    )
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert "service.host" in ended.stderr
    assert "autospine token" in ended.stderr


def test_without_a_token_nothing_of_the_api_answers(url: str) -> None:
    asked = [o for o in operations(url) if o[1].startswith("/api/") and o != LOGIN]
    assert len(asked) > 20
    for method, path in asked:
        answer = httpx.request(method, url + path)
        check_problem(answer, 401, "unauthorized")
        assert answer.headers["www-authenticate"] == "Bearer"
    assert httpx.get(url + "/metrics").status_code == 401
    assert httpx.get(url + "/").status_code == 200


LOGIN = ("POST", "/api/v1/session")


def test_a_viewer_can_order_nothing_but_stop(url: str) -> None:
    orders = [o for o in operations(url) if o[0] != "GET" and o[1] != "/api/v1/session"]
    assert len(orders) > 10
    for method, path in orders:
        answer = httpx.request(method, url + path, headers=bearer(VIEWER), json={})
        if path == "/api/v1/stop":
            assert answer.status_code == 202
        else:
            check_problem(answer, 403, "wrong_role")


def test_the_name_of_the_token_is_recorded_whatever_the_body_says(url: str) -> None:
    httpx.post(f"{url}/api/v1/stop", headers=bearer(VIEWER), json={"by": "somebody else"})
    body = {"by": "Napoleon", "label": "named"}
    saved = httpx.put(f"{url}/api/v1/case", headers=bearer(OPERATOR), json=body)
    assert saved.status_code == 204
    events = httpx.get(f"{url}/api/v1/events", headers=bearer(VIEWER)).json()
    recorded = {(event["kind"], event["who"]) for event in events}
    assert ("stop", "Victor") in recorded
    assert ("case_described", "Olga") in recorded
    assert not {who for _, who in recorded} & {"somebody else", "Napoleon"}


def test_an_expired_token_is_no_token(url: str) -> None:
    answer = httpx.get(f"{url}/api/v1/state", headers=bearer(EXPIRED))
    check_problem(answer, 401, "unauthorized")


def test_a_login_is_an_http_only_cookie_and_orders_need_its_csrf_token(url: str) -> None:
    with httpx.Client(base_url=url) as browser:
        logged_in = browser.post("/api/v1/session", json={"token": OPERATOR})
        cookie = logged_in.headers["set-cookie"].lower()
        assert "httponly" in cookie
        assert "samesite=strict" in cookie
        assert logged_in.json()["name"] == "Olga"
        order = {"json": {"label": "x"}}
        check_problem(browser.put("/api/v1/case", **order), 403, "csrf")
        csrf = {"X-CSRF-Token": logged_in.json()["csrf"]}
        assert browser.put("/api/v1/case", **order, headers=csrf).status_code == 204
        # a STOP is not kept back by a lost CSRF token
        assert browser.post("/api/v1/stop").status_code == 202
        assert browser.delete("/api/v1/session", headers=csrf).status_code == 204
        check_problem(browser.get("/api/v1/state"), 401, "unauthorized")


def test_wrong_tokens_lock_an_address_out_but_not_its_sessions_and_not_stop(url: str) -> None:
    with httpx.Client(base_url=url) as browser:
        browser.post("/api/v1/session", json={"token": OPERATOR})
        for _ in range(3):
            wrong = httpx.get(f"{url}/api/v1/state", headers=bearer("wrong"))
            check_problem(wrong, 401, "unauthorized")
        locked = httpx.get(f"{url}/api/v1/state", headers=bearer(OPERATOR))
        check_problem(locked, 429, "locked_out")
        assert 1 <= int(locked.headers["retry-after"]) <= 6
        answer = httpx.post(f"{url}/api/v1/session", json={"token": OPERATOR})
        check_problem(answer, 429, "locked_out")
        assert browser.get("/api/v1/state").status_code == 200
        assert httpx.post(f"{url}/api/v1/stop", headers=bearer(OPERATOR)).status_code == 202
        wait_s = int(locked.headers["retry-after"])
    time.sleep(wait_s)
    assert until_let_in(url, patience_s=60.0)


def until_let_in(url: str, patience_s: float) -> bool:
    end_s = time.monotonic() + patience_s
    while time.monotonic() < end_s:
        if httpx.get(f"{url}/api/v1/state", headers=bearer(OPERATOR)).status_code == 200:
            return True
        time.sleep(0.1)
    return False


def test_without_tokens_other_web_pages_are_kept_out(open_url: str) -> None:
    body = {"label": "x"}
    foreign = {"Origin": "http://evil.example"}
    answer = httpx.put(f"{open_url}/api/v1/case", json=body, headers=foreign)
    check_problem(answer, 403, "cross_origin")
    rebound = {"Host": "evil.example"}
    check_problem(httpx.get(f"{open_url}/api/v1/state", headers=rebound), 403, "wrong_host")
    own = {"Origin": open_url}
    assert httpx.put(f"{open_url}/api/v1/case", json=body, headers=own).status_code == 204
    session = httpx.get(f"{open_url}/api/v1/session").json()
    assert session == {"name": "operator", "role": "operator", "csrf": "", "needs_token": False}


def test_bodies_that_are_too_large_or_no_json_are_refused(open_url: str) -> None:
    target = f"{open_url}/api/v1/case"
    json_type = {"Content-Type": "application/json"}
    huge = b'{"note": "' + b"x" * 200_000 + b'"}'
    check_problem(httpx.put(target, content=huge, headers=json_type), 413, "too_large")
    pieces = (huge[k : k + 10_000] for k in range(0, len(huge), 10_000))
    check_problem(httpx.put(target, content=pieces, headers=json_type), 413, "too_large")
    cut = httpx.put(target, content=b'{"label": ', headers=json_type)
    check_problem(cut, 400, "malformed_json")
    nan = httpx.put(
        f"{open_url}/api/v1/target", content=b'{"patient_mm": [NaN, 0, 0]}', headers=json_type
    )
    assert nan.status_code in (400, 422)
    unknown = httpx.put(target, json={"lable": "x"})
    assert "lable" in check_problem(unknown, 422, "invalid_request")["detail"]


def test_a_stop_is_taken_with_any_body(open_url: str) -> None:
    for content in (b"", b"{", b'{"by": 7}', b'"stop"', b"\xff\xfe"):
        assert httpx.post(f"{open_url}/api/v1/stop", content=content).status_code == 202


@pytest.mark.parametrize("path", ["/", "/page/main.js", "/api/v1/state", "/api/v1/slices/1", "/x"])
def test_every_answer_carries_the_security_headers(open_url: str, path: str) -> None:
    headers = httpx.get(open_url + path).headers
    assert "default-src 'none'" in headers["content-security-policy"]
    assert "unsafe-inline" not in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["x-frame-options"] == "DENY"
    assert headers["referrer-policy"] == "no-referrer"
    assert "server" not in headers


def test_with_certificate_and_key_the_page_is_served_over_https(tmp_path: Path) -> None:
    authority = trustme.CA()
    issued = authority.issue_cert("127.0.0.1")
    issued.private_key_pem.write_to_path(tmp_path / "key.pem")
    issued.cert_chain_pems[0].write_to_path(tmp_path / "certificate.pem")
    authority.cert_pem.write_to_path(tmp_path / "authority.pem")
    # relative to the configuration file, wherever the service was started
    tls = 'tls_certificate = "certificate.pem"\ntls_key = "key.pem"\n'
    with running_service(tmp_path, tls + TOKENS) as url:
        assert url.startswith("https://")
        trusting = ssl.create_default_context(cafile=str(tmp_path / "authority.pem"))
        with httpx.Client(base_url=url, verify=trusting) as browser:
            answer = browser.post("/api/v1/session", json={"token": OPERATOR})
            assert "secure" in answer.headers["set-cookie"].lower()
            assert "max-age" in answer.headers["strict-transport-security"]


def test_a_certificate_that_is_none_is_one_clear_line(tmp_path: Path) -> None:
    config = tmp_path / "room.toml"
    config.write_text(CONFIG + 'tls_certificate = "none.pem"\ntls_key = "none.pem"\n')
    ended = subprocess.run(
        autospine("service", "--config", str(config)), capture_output=True, text=True, timeout=60
    )
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1), ended.stderr
    assert "tls_certificate" in ended.stderr


def test_the_token_command_makes_a_token_whose_hash_lets_in() -> None:
    made = subprocess.run(
        autospine("token", 'Dr. "Q"', "--role", "operator"), capture_output=True, text=True
    )
    secret = made.stdout.splitlines()[1]
    table = made.stdout[made.stdout.index("[[service.token]]") :]
    assert secret not in table
    known = tuple(AccessToken(**row) for row in tomllib.loads(table)["service"]["token"])
    identity = Access(rules(tokens=known)).check_token(secret, "a", now_s=0.0, wall_s=0.0)
    assert (identity.name, identity.role) == ('Dr. "Q"', "operator")


def rules(**changes: Any) -> AccessRules:
    token = AccessToken(name="Olga", role="operator", sha256=token_hash(OPERATOR))
    values = {"tokens": (token,), "session_s": 10.0, "lock_out_after": 3, "lock_out_s": 60.0}
    return AccessRules(**{**values, **changes})


def test_failures_count_for_each_address_by_itself_and_only_for_a_while() -> None:
    access = Access(rules())

    def ask(token: str, address: str, now_s: float) -> str:
        return access.check_token(token, address, now_s=now_s, wall_s=0.0).name

    for now_s in (0.0, 1.0, 2.0):
        with pytest.raises(PermissionError):
            ask("wrong", "a", now_s)
    with pytest.raises(LockedOutError) as locked:
        ask(OPERATOR, "a", 3.0)
    assert locked.value.wait_s == pytest.approx(59.0)
    assert ask(OPERATOR, "b", 3.0) == "Olga"
    assert ask(OPERATOR, "a", 63.0) == "Olga"


def test_a_session_ends_after_its_time() -> None:
    access = Access(rules())
    identity = access.check_token(OPERATOR, "a", now_s=0.0, wall_s=0.0)
    secret, _ = access.open_session(identity, now_s=0.0)
    assert access.session(secret, 9.9, 0.0) is not None
    assert access.session(secret, 10.0, 0.0) is None
    assert access.session("another", 1.0, 0.0) is None


def test_the_scanner_finds_its_token_in_the_environment_or_in_its_file(tmp_path: Path) -> None:
    path = tmp_path / "scanner.token"
    path.write_text("from the file\n")

    def settings(token_file: object) -> ScannerSettings:
        return ScannerSettings(
            service_url="http://127.0.0.1:1",
            listener_port=1,
            motors_truth_port=1,
            truth_file="truth",
            token_file=str(token_file),
        )

    assert read_token(settings(path), {}) == "from the file"
    assert read_token(settings(path), {"AUTOSPINE_TOKEN": "from outside"}) == "from outside"
    assert read_token(settings(""), {}) == ""
    with pytest.raises(VirtualRoomError, match=r"token_file: .*nowhere: cannot be read"):
        read_token(settings(tmp_path / "nowhere"), {})
    path.write_text(" \n")
    with pytest.raises(VirtualRoomError, match="is empty"):
        read_token(settings(path), {})
