# SPDX-License-Identifier: Apache-2.0
"""The bridge and a router over TLS: it joins with the right certificates, and else says which file is wrong."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import pytest

from services.ros2.config import RouterTlsConfig
from services.ros2.rmw_names import endpoint_of
from services.ros2.router_tls import router_tls
from shared.config import UserError
from shared.secure_folder import SecureFolder
from tests.unit.services.ros2.network import Bridge, RosPeer, free_port, router, session
from zenav.secure.authority import Authority, Issued, new_authority

TODAY, UNTIL = date(2026, 1, 1), date(2099, 1, 1)
ENDPOINT = "tls/127.0.0.1:7447"


@dataclass(frozen=True)
class Certificates:
    """Files of one authority: its own certificate, the router's for 127.0.0.1, and a member's."""

    ca: Path
    router: Path
    router_key: Path
    member: Path
    member_key: Path

    def listening(self) -> dict[str, Any]:
        """Zenoh's settings of a router that asks members for their certificate."""
        return {
            "enable_mtls": True,
            "root_ca_certificate": str(self.ca),
            "listen_certificate": str(self.router),
            "listen_private_key": str(self.router_key),
        }

    def section(self, **changed: Any) -> dict[str, Any]:
        """The section ros2.tls of a member."""
        files = {"ca": str(self.ca), "certificate": str(self.member), "key": str(self.member_key)}
        return {"tls": RouterTlsConfig(**{**files, **changed})}


def certificates(folder: Path, names: list[str]) -> Certificates:
    """A new authority in a folder, with a router's certificate for these names."""
    folder.mkdir()
    place = SecureFolder(folder)
    own = new_authority("router", TODAY)
    place.authority_key.write_bytes(own.key)
    place.authority_certificate.write_bytes(own.certificate)
    authority = Authority(place)

    def written(name: str, issued: Issued) -> tuple[Path, Path]:
        paths = folder / f"{name}.pem", folder / f"{name}.key"
        paths[0].write_bytes(issued.certificate)
        paths[1].write_bytes(issued.key)
        return paths

    server = written("router", authority.robot(names, UNTIL))
    return Certificates(place.authority_certificate, *server, *written("member", authority.member("robot.1", UNTIL)))


@pytest.fixture(scope="module")
def ours(tmp_path_factory) -> Certificates:
    return certificates(tmp_path_factory.mktemp("tls") / "ours", ["127.0.0.1"])


@pytest.fixture(scope="module")
def others(tmp_path_factory) -> Certificates:
    return certificates(tmp_path_factory.mktemp("tls") / "others", ["elsewhere.example"])


@contextmanager
def tls_router(files: Certificates) -> Iterator[int]:
    """A router with TLS that asks for certificates, and its port."""
    port = free_port()
    with router(port, "tls", **{"transport/link/tls": files.listening()}):
        yield port


@contextmanager
def bridge_to(port: int, **section: Any) -> Iterator[Bridge]:
    bridge = Bridge(port, None, "tls", **section)
    bridge.device.start()
    try:
        yield bridge
    finally:
        bridge.device.close()


def test_a_bridge_with_the_right_certificates_is_seen_by_another_member(ours):
    member = {"transport/link/tls": router_tls(ENDPOINT, ours.section()["tls"])}
    with tls_router(ours) as port, bridge_to(port, **ours.section()) as bridge:
        bridge.wait_open()
        with session("client", port, protocol="tls", **member) as opened:
            tokens = map(endpoint_of, RosPeer(opened, bridge.types).tokens())
            assert "/scan" in {endpoint.topic.name for endpoint in tokens if endpoint is not None}


@pytest.mark.parametrize("wrong", ["authority", "no certificate of its own"])
def test_a_bridge_that_does_not_fit_the_router_says_so(ours, others, wrong):
    changed = {"ca": str(others.ca)} if wrong == "authority" else {"certificate": "", "key": ""}
    with tls_router(ours) as port, bridge_to(port, **ours.section(**changed)) as bridge:
        bridge.wait(lambda: bridge.states)
        assert not bridge.states[0][0]
        assert "ros2.tls fit" in bridge.states[0][1]


def test_a_router_under_another_name_is_refused_unless_names_do_not_count(others):
    with tls_router(others) as port:
        with bridge_to(port, **others.section()) as bridge:
            bridge.wait(lambda: bridge.states)
            assert not bridge.states[0][0]
        with bridge_to(port, **others.section(verify_name=False)) as bridge:
            bridge.wait_open()


def problem(endpoint: str = ENDPOINT, **section: str) -> tuple[str, str]:
    with pytest.raises(UserError) as error:
        router_tls(endpoint, RouterTlsConfig(**section))
    assert "\n" not in error.value.what + error.value.hint
    return error.value.what, error.value.hint


@pytest.mark.parametrize("name", ["ca", "certificate", "key"])
def test_a_missing_file_is_named_with_its_setting(tmp_path, name):
    what, hint = problem(**{name: str(tmp_path / "none.pem")})
    assert what == f"ros2.tls.{name}: {tmp_path}/none.pem cannot be read: No such file or directory"
    assert hint == "give the path of a PEM file that this user may read"


def test_a_folder_is_no_file(tmp_path):
    assert problem(ca=str(tmp_path))[0] == f"ros2.tls.ca: {tmp_path} cannot be read: Is a directory"


def test_files_that_are_no_certificate_or_no_pair_are_named(tmp_path, ours):
    (tmp_path / "text").write_text("hello")
    assert problem(ca=str(tmp_path / "text"))[0] == f"ros2.tls.ca: {tmp_path}/text holds no certificate"
    what, _ = problem(certificate=str(ours.member), key=str(ours.router_key))
    assert what == f"ros2.tls: {ours.member} and {ours.router_key} are no pair"


def test_a_certificate_without_its_key_and_files_for_a_router_without_tls_are_errors(ours):
    assert "belong together" in problem(certificate=str(ours.member))[0]
    assert problem("tcp/127.0.0.1:7447", ca=str(ours.ca)) == (
        "ros2.tls is set, but tcp/127.0.0.1:7447 has no TLS", "write zenoh://tls/HOST:7447",
    )  # fmt: skip


def test_a_wrong_file_ends_the_bridge_before_it_begins(tmp_path):
    with pytest.raises(UserError, match=r"ros2\.tls\.ca"):
        Bridge(7447, None, "tls", tls=RouterTlsConfig(ca=str(tmp_path / "none.pem")))


def test_without_tls_nothing_is_set():
    assert router_tls("tcp/127.0.0.1:7447", RouterTlsConfig()) == {}
