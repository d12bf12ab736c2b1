# SPDX-License-Identifier: Apache-2.0
"""Before a start that shows the robot's certificate: it is there and renewed, and the user's address counts."""

import json
from datetime import timedelta

import pytest

from shared.config import UserError, configured
from shared.runners.transport import StackAddress
from shared.secure_folder import SecureFolder
from zenav.secure import members
from zenav.stack.gateway import gateway_address, prepare_gateway, prepare_page, with_gateway


@pytest.fixture
def folder(tmp_path, monkeypatch) -> SecureFolder:
    monkeypatch.setenv("ZENAV_SECURE", str(tmp_path / "secure"))
    return SecureFolder(tmp_path / "secure")


def ends_soon(folder: SecureFolder) -> bytes:
    """Makes a certificate that ends in 10 days, as far as robot.json says; returns it."""
    members.init_folder("x80sv", "", [])
    row = json.loads(folder.robot_file.read_text())
    until = (members.today() + timedelta(days=10)).isoformat()
    folder.write(folder.robot_file, json.dumps({**row, "until": until}).encode())
    return folder.robot_certificate.read_bytes()


def test_the_gateway_of_a_stack_has_its_own_port_and_the_users_address_counts():
    file = configured("x80sv", with_gateway([], StackAddress(3)))
    assert gateway_address(file) == "tls/0.0.0.0:7451"
    named = ["gateway.port.device=tls://192.168.1.20:9000"]
    assert gateway_address(configured("x80sv", with_gateway(named, StackAddress(3)))) == "tls/192.168.1.20:9000"


@pytest.mark.parametrize("device", ["tls://0.0.0.0", "tcp://0.0.0.0:1", "tls://:7448", "robot.local"])
def test_a_wrong_address_is_one_clear_error(device):
    with pytest.raises(UserError, match="is no address"):
        prepare_gateway(configured("x80sv", [f"gateway.port.device={device}"]))


def test_without_certificates_the_gateway_does_not_start(folder):
    with pytest.raises(UserError, match="no certificates"):
        prepare_gateway(configured("x80sv", with_gateway([], StackAddress())))


@pytest.mark.parametrize("url", ["https://robot.local:8600", None])
def test_a_certificate_that_ends_soon_is_renewed_before_the_start(folder, url):
    before = ends_soon(folder)
    if url is None:
        prepare_gateway(configured("x80sv", with_gateway([], StackAddress())))
    else:
        prepare_page(url)
    assert folder.robot_certificate.read_bytes() != before
    assert folder.robot_days_left(members.today()) > 300


def test_a_page_of_this_computer_alone_needs_no_certificate(folder):
    prepare_page("http://127.0.0.1:8600")
    assert not folder.exists
    before = ends_soon(folder)
    prepare_page("http://127.0.0.1:8600")
    assert folder.robot_certificate.read_bytes() == before
