# SPDX-License-Identifier: Apache-2.0
"""TLS to the router of the ROS 2 nodes: Zenoh's settings from the certificates of the configuration."""

import ssl
from pathlib import Path
from typing import Any

from services.ros2.config import RouterTlsConfig
from shared.config import UserError
from shared.credentials import TLS


def router_tls(endpoint: str, config: RouterTlsConfig) -> dict[str, Any]:
    """Zenoh's `transport/link/tls` of a session with the router; empty for an endpoint without TLS.

    Raises UserError where a file is missing or not what it should be, and where the endpoint and the files contradict.
    """
    ca, certificate, key = (_path(name, getattr(config, name)) for name in ("ca", "certificate", "key"))
    if not endpoint.startswith(TLS):
        if ca or certificate or key:
            raise UserError(f"ros2.tls is set, but {endpoint} has no TLS", "write zenoh://tls/HOST:7447")
        return {}
    if bool(certificate) != bool(key):
        raise UserError("ros2.tls.certificate and ros2.tls.key belong together", "set both, or neither")
    context = ssl.create_default_context()
    if ca:
        try:
            context.load_verify_locations(ca)
        except ssl.SSLError:
            hint = "give the PEM certificate of the authority that signed the router's"
            raise UserError(f"ros2.tls.ca: {ca} holds no certificate", hint) from None
    if certificate and key:
        try:
            context.load_cert_chain(certificate, key, password="")
        except ssl.SSLError:
            hint = "give a PEM certificate, and its own key without a passphrase"
            raise UserError(f"ros2.tls: {certificate} and {key} are no pair", hint) from None
    settings: dict[str, Any] = {"verify_name_on_connect": config.verify_name, "close_link_on_expiration": True}
    if ca:
        settings["root_ca_certificate"] = str(ca)
    if certificate and key:
        files = {"connect_certificate": str(certificate), "connect_private_key": str(key)}
        settings |= {"enable_mtls": True, **files}
    return settings


def _path(name: str, text: str) -> Path | None:
    """The file of a setting, which can be read; None without one."""
    if not text:
        return None
    path = Path(text).expanduser()
    try:
        path.open("rb").close()
    except OSError as error:
        hint = "give the path of a PEM file that this user may read"
        raise UserError(f"ros2.tls.{name}: {path} cannot be read: {error.strerror}", hint) from None
    return path
