# SPDX-License-Identifier: Apache-2.0
"""A member's credentials: one file with its key, its certificate and the authority's, and how a session uses them.

    zenav credentials 1
    name: anna
    role: operator
    robot: x80sv
    until: 2027-11-23
    -----BEGIN PRIVATE KEY----- ... and two certificates: the member's, then the authority's

A tool finds the file by the router's host, as ssh finds known hosts: `credentials/HOST.pem` in the user's configuration
folder, or where ZENAV_CREDENTIALS says.
"""

import os
import re
from base64 import b64encode
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shared.config import UserError
from shared.secure_folder import configuration_folder

TLS = "tls/"
HEAD = "zenav credentials 1"
_BLOCK = re.compile(r"-----BEGIN ([A-Z ]+)-----\n.*?\n-----END \1-----\n", re.DOTALL)
_KINDS = ["PRIVATE KEY", "CERTIFICATE", "CERTIFICATE"]


@dataclass(frozen=True, slots=True)
class Credentials:
    """The three PEM blocks, and what the head says of their owner."""

    name: str
    role: str
    robot: str
    until: str
    key: str
    certificate: str
    authority: str

    def text(self) -> str:
        """The file."""
        head = f"{HEAD}\nname: {self.name}\nrole: {self.role}\nrobot: {self.robot}\nuntil: {self.until}\n"
        return head + self.key + self.certificate + self.authority

    def tls(self) -> dict[str, Any]:
        """Zenoh's `transport/link/tls` of a session that connects.

        The server's name is not compared: addresses of robots change. Only the robot's own certificate is one for
        servers, so another member cannot take its place.
        """
        return {
            "enable_mtls": True,
            "verify_name_on_connect": False,
            "close_link_on_expiration": True,
            "root_ca_certificate_base64": _base64(self.authority),
            "connect_certificate_base64": _base64(self.certificate),
            "connect_private_key_base64": _base64(self.key),
        }


def parsed_credentials(text: str, source: str) -> Credentials:
    """The credentials in a file's text. Raises UserError where it is none; `source` names the file."""
    lines = text.splitlines()
    head = dict(line.split(": ", 1) for line in lines[1:5] if ": " in line)
    blocks = [(match[1], match[0]) for match in _BLOCK.finditer(text)]
    if lines[:1] != [HEAD] or [kind for kind, _ in blocks] != _KINDS or {"name", "role", "robot", "until"} - set(head):
        raise UserError(f"{source} holds no credentials", "it is the file that `zenav secure add` wrote")
    key, certificate, authority = (block for _, block in blocks)
    return Credentials(**head, key=key, certificate=certificate, authority=authority)


def credentials_for(endpoint: str) -> Credentials:
    """The credentials for a router like tls/HOST:PORT.

    Raises UserError where there are none, or others may read them.
    """
    given = os.environ.get("ZENAV_CREDENTIALS", "")  # noqa: TID251  # a container has no configuration folder
    return read_credentials(Path(given) if given else credentials_file(endpoint_host(endpoint)), endpoint)


def read_credentials(file: Path, endpoint: str = "the link") -> Credentials:
    """The credentials in a file. endpoint: what asks for them.

    Raises UserError where there are none, or others may read them.
    """
    try:
        text = file.read_text()
    except (OSError, UnicodeDecodeError):
        hint = "get a file from `zenav secure add NAME` on the robot, then: zenav secure accept FILE"
        raise UserError(f"{endpoint} asks for credentials, and {file} cannot be read", hint) from None
    if file.stat().st_mode & 0o077:
        raise UserError(f"others may read {file}", f"chmod 600 {file}")
    return parsed_credentials(text, str(file))


def credentials_file(host: str) -> Path:
    """Where the credentials for a host are kept."""
    return configuration_folder() / "credentials" / f"{host}.pem"


def tls_endpoint(device: str, setting: str, example: str) -> str:
    """Zenoh's endpoint of a port's device tls://HOST:PORT. Raises UserError, which names `setting` and `example`."""
    kind, _, address = device.partition("://")
    host, _, port = address.rpartition(":")
    if kind != "tls" or not host or not port.isdecimal():
        raise UserError(f"{setting}: {device!r} is no address", f"write {example}")
    return f"{TLS}{address}"


def endpoint_host(endpoint: str) -> str:
    """HOST of tls/HOST:PORT, as part of a file's name. Raises UserError where there is none."""
    host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._:-]{0,252}", host):
        raise UserError(f"{endpoint!r} names no host", "write tls/HOST:7448")
    return host


def _base64(text: str) -> str:
    return b64encode(text.encode()).decode()
