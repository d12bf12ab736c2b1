# SPDX-License-Identifier: Apache-2.0
"""The certificate authority of one robot: keys and certificates (RFC 5280), elliptic curve P-256.

A certificate holds from 1970 on: a computer that begins without a clock would reject one that begins today, and lock
its owner out. The robot's certificate alone is one for servers, members have one for clients. So no member can stand
in for the robot.
"""

import re
import socket
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from ipaddress import ip_address

import psutil
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from shared.config import UserError
from shared.credentials import Credentials
from shared.secure_folder import SecureFolder

BEGIN = datetime(1970, 1, 2, tzinfo=UTC)
AUTHORITY_DAYS = 20 * 365
ROBOT_DAYS = 365
MAX_NAMES = 50
_HOST = re.compile(r"(?=.{1,253}$)[A-Za-z0-9]([A-Za-z0-9-]*[A-Za-z0-9])?(\.[A-Za-z0-9]([A-Za-z0-9-]*[A-Za-z0-9])?)*")


@dataclass(frozen=True, slots=True)
class Issued:
    """A private key and its certificate, PEM."""

    key: bytes
    certificate: bytes


class Authority:
    """The authority of a folder. Raises UserError where its key is missing or damaged."""

    def __init__(self, folder: SecureFolder) -> None:
        try:
            key = serialization.load_pem_private_key(folder.authority_key.read_bytes(), None)
            self.certificate = folder.authority_certificate.read_bytes()
            self._certificate = x509.load_pem_x509_certificate(self.certificate)
        except FileNotFoundError as error:
            raise UserError(
                f"{error.filename} is missing", "bring it back, or begin again: zenav secure init"
            ) from None
        except (ValueError, TypeError):
            raise UserError(f"the authority in {folder.path} is damaged", "restore it from a backup") from None
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise UserError(f"{folder.authority_key} is no key of zenav", "restore it from a backup")
        self._key = key

    def robot(self, names: list[str], until: date) -> Issued:
        """The robot's own certificate, for servers, with its host's names and addresses."""
        alternatives = x509.SubjectAlternativeName([_general_name(name) for name in names])
        return self._issue("robot", until, ExtendedKeyUsageOID.SERVER_AUTH, alternatives)

    def member(self, common_name: str, until: date) -> Issued:
        """A member's certificate, for clients."""
        return self._issue(common_name, until, ExtendedKeyUsageOID.CLIENT_AUTH, None)

    def credentials(self, name: str, role: str, robot: str, common_name: str, until: date) -> Credentials:
        """The file of a member."""
        issued = self.member(common_name, until)
        return Credentials(
            name=name,
            role=role,
            robot=robot,
            until=until.isoformat(),
            key=issued.key.decode(),
            certificate=issued.certificate.decode(),
            authority=self.certificate.decode(),
        )

    def _issue(
        self,
        common_name: str,
        until: date,
        usage: x509.ObjectIdentifier,
        alternatives: x509.SubjectAlternativeName | None,
    ) -> Issued:
        key = ec.generate_private_key(ec.SECP256R1())
        builder = _builder(common_name, self._certificate.subject, key, until).add_extension(
            x509.BasicConstraints(ca=False, path_length=None), critical=True
        )
        builder = builder.add_extension(x509.ExtendedKeyUsage([usage]), critical=False)
        identifier = x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key())
        builder = builder.add_extension(identifier, critical=False)
        if alternatives is not None:
            builder = builder.add_extension(alternatives, critical=False)
        return _issued(key, builder.sign(self._key, hashes.SHA256()))


def new_authority(robot: str, today: date) -> Issued:
    """A new authority, signed by itself."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = f"zenav authority of {robot}"
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    builder = _builder(name, subject, key, today + timedelta(days=AUTHORITY_DAYS))
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    usage = x509.KeyUsage(
        digital_signature=False,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=True,
        crl_sign=True,
        encipher_only=False,
        decipher_only=False,
    )
    builder = builder.add_extension(usage, critical=True)
    identifier = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
    return _issued(key, builder.add_extension(identifier, critical=False).sign(key, hashes.SHA256()))


def fingerprint(certificate: bytes) -> str:
    """SHA-256 of a PEM certificate, as browsers show it."""
    digest = x509.load_pem_x509_certificate(certificate).fingerprint(hashes.SHA256())
    return digest.hex(":").upper()


def host_names() -> list[str]:
    """Names and addresses by which this computer may be reached, its own ones included."""
    name = socket.gethostname()
    short = name.partition(".")[0]
    addresses = [
        address.address.partition("%")[0]
        for interface in psutil.net_if_addrs().values()
        for address in interface
        if address.family in (socket.AF_INET, socket.AF_INET6)
    ]
    names = ["localhost", name, f"{short}.local", "127.0.0.1", "::1", *addresses]
    return [name for name in dict.fromkeys(names) if _is_host(name)][:MAX_NAMES]


def checked_host(name: str) -> str:
    """A host's name or address. Raises UserError where it is none."""
    if not _is_host(name):
        raise UserError(f"{name!r} is no name of a host", "write robot.local, or 192.168.1.20")
    return name


def _is_host(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return _HOST.fullmatch(name) is not None
    return True


def _general_name(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(name))
    except ValueError:
        return x509.DNSName(name)


def _builder(
    common_name: str, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, until: date
) -> x509.CertificateBuilder:
    end = datetime(until.year, until.month, until.day, 23, 59, 59, tzinfo=UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)]))
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(BEGIN)
        .not_valid_after(end)
    )


def _issued(key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate) -> Issued:
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return Issued(private, certificate.public_bytes(serialization.Encoding.PEM))
