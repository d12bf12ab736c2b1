# SPDX-License-Identifier: Apache-2.0
"""A robot's certificate for tests, as `zenav secure init` leaves it in the secure folder."""

from datetime import UTC, datetime, timedelta
from functools import cache
from ipaddress import ip_address
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from shared.secure_folder import SecureFolder

REMOTE = "127.0.0.2"
"""An address of this computer that counts as another computer's."""
NAMES = ("localhost", "robot.local", "*.robots.example", "127.0.0.1", REMOTE)


@cache
def certificate_and_key(days: float = 365.0, names: tuple[str, ...] = NAMES) -> tuple[bytes, bytes]:
    """PEM of a certificate of these names that signs itself, and of its key. days: to its end."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "robot")])
    now = datetime.now(UTC)  # noqa: TID251  # of certificates
    subjects = [x509.IPAddress(ip_address(n)) if n[0].isdigit() else x509.DNSName(n) for n in names]
    builder = x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
    builder = builder.not_valid_before(now - timedelta(days=400)).not_valid_after(now + timedelta(days=days))
    signed = builder.add_extension(x509.SubjectAlternativeName(subjects), False).sign(key, hashes.SHA256())
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return signed.public_bytes(serialization.Encoding.PEM), private


def make_credentials(path: Path, days: float = 365.0, names: tuple[str, ...] = NAMES) -> SecureFolder:
    """The folder with the robot's certificate."""
    folder = SecureFolder(path)
    certificate, key = certificate_and_key(days, names)
    folder.write(folder.robot_certificate, certificate)
    folder.write(folder.robot_key, key)
    return folder
