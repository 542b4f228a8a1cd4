"""Who may ask a service: others with a token, through a proxy, from pages of other sites; names of photos."""

import socket
from contextlib import contextmanager

import pytest
from refusals import assert_input_error
from services import serving

from piccolo.apps.service.asking import clean_name
from piccolo.apps.service.serve import check_url

TIER = "process"

PUBLIC = "https://scans.example/flat/"
SHOP = "https://shop.example"


@contextmanager
def _behind_proxy(scene):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    words = ["--jobs", "1", "--public-url", PUBLIC, "--allow-origin", SHOP, "--port", port]
    with serving("--cloud", scene / "cloud.ply", "--cache", scene.parent / "maps", *words) as client:
        client.token = client.address.removeprefix(f"{PUBLIC}enter?token=")
        yield client


def test_others_need_the_token(scene):
    words = ["--host", "0.0.0.0", "--jobs", "1"]
    with serving("--cloud", scene / "cloud.ply", "--cache", scene.parent / "maps", *words) as client:
        token = client.address.split("token=")[1]
        for path in ("/", "/scan", "/report.js", "/app.js"):
            status, headers, _ = client.ask("GET", path)
            assert (status, headers["www-authenticate"]) == (401, "Bearer")
            assert client.ask("GET", path, Authorization="Bearer wrong")[0] == 401
            assert client.ask("GET", path, Authorization=f"Bearer {token}")[0] == 200
        status, headers, _ = client.ask("GET", f"/enter?token={token}")
        assert (status, headers["location"]) == (303, "/")
        assert "httponly" in headers["set-cookie"].lower()
        assert "secure" not in headers["set-cookie"].lower()
        cookie = headers["set-cookie"].split(";")[0]
        assert client.ask("GET", "/", Cookie=cookie)[0] == 200
        assert client.ask("GET", "/health")[0] == 200


def test_a_page_behind_a_proxy_and_pages_of_another_site(scene):
    photo = (scene / "images" / "clean_0.jpg").read_bytes()
    with _behind_proxy(scene) as client:
        for prefix in ("", "/flat"):  # which a proxy leaves out, or in
            status, headers, _ = client.ask(
                "GET", f"{prefix}/enter?token={client.token}", Host="scans.example"
            )
            assert (status, headers["location"]) == (303, "/flat/")
            assert {"Path=/flat/", "Secure", "HttpOnly"} <= set(headers["set-cookie"].split("; "))
            cookie = headers["set-cookie"].split(";")[0]
            for host in ("scans.example", "127.0.0.1:8765"):
                asked = {"Host": host, "Origin": "https://scans.example", "Cookie": cookie}
                assert client.ask("GET", f"{prefix}/", **asked)[0] == 200
                assert client.post(f"{prefix}/localize", "a.jpg", photo, **asked)[0] == 200
        bearer = {"Authorization": f"Bearer {client.token}"}
        status, headers, _ = client.post("/localize", "a.jpg", photo, Origin=SHOP, **bearer)
        assert (status, headers["access-control-allow-origin"]) == (200, SHOP)
        evil = client.post("/localize", "a.jpg", photo, Origin="https://evil.example", **bearer)
        assert evil[0] == 403
        assert "access-control-allow-origin" not in evil[1]
        told = {"Access_Control_Request_Method": "POST", "Access_Control_Request_Headers": "authorization"}
        status, headers, _ = client.ask("OPTIONS", "/localize", Origin=SHOP, **told)
        assert (status, headers["access-control-allow-origin"]) == (200, SHOP)
        assert "authorization" in headers["access-control-allow-headers"].lower()
        assert client.ask("OPTIONS", "/localize", Origin="https://evil.example", **told)[0] == 400


@pytest.mark.parametrize(
    ("url", "page"),
    [
        ("https://Scans.example/flat", "https://scans.example/flat/"),
        ("http://10.0.0.1:8080", "http://10.0.0.1:8080/"),
        (PUBLIC, PUBLIC),
    ],
)
def test_an_address_ends_in_a_slash(url, page):
    assert check_url("public_url", url, True) == page


@pytest.mark.parametrize(
    "url", ["scans.example", "ftp://x/", "https:///x", "https://u@x/", "https://x/?a", "http://[x"]
)
def test_what_is_no_address_is_refused(url):
    assert_input_error("`public_url`: found .*, wanted http", check_url, "public_url", url, True)
    assert_input_error("wanted http\\(s\\)://HOST$", check_url, "allow_origin", f"{SHOP}/page", False)


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ("a.jpg", "a.jpg"),
        ("../../etc/passwd", "passwd"),
        ("C:\\x\\b.png", "b.png"),
        ("Tom & Jerry's <1> 😀 50 %.jpg", "Tom & Jerry's <1> 😀 50 %.jpg"),
        (".hidden.jpg", ".hidden.jpg"),
        ("..", "photo"),
        ("", "photo"),
        ("a\0/b\r\n.jpg", "b__.jpg"),
        ("x" * 300 + ".jpg", "x" * 236 + ".jpg"),
    ],
)
def test_names_are_no_paths(given, name):
    assert clean_name(given) == name
