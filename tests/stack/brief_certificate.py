# SPDX-License-Identifier: Apache-2.0
"""Credentials of a member whose certificate ends within a test."""

from datetime import UTC, datetime, timedelta

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from shared.credentials import Credentials
from shared.secure_folder import Member, MemberRole, SecureFolder

NAME, COMMON_NAME = "brief", "brief.1"
DAY_S = 86400.0


def admit_brief(place: SecureFolder) -> None:
    """Makes `brief` an operator. A gateway starts again then, before it lets the member in."""
    others = [member for member in place.members() if member.name != NAME]
    place.write_members([*others, Member(NAME, MemberRole.OPERATOR, COMMON_NAME, _end(DAY_S).date().isoformat())])


def brief_credentials(place: SecureFolder, robot: str, seconds: float) -> Credentials:
    """Credentials of the operator `brief`, whose certificate ends so many seconds from now."""
    return _credentials_until(place, robot, COMMON_NAME, _end(seconds))


def _end(seconds: float) -> datetime:
    return datetime.now(UTC) + timedelta(seconds=seconds)  # noqa: TID251  # certificates end by the wall clock


def _credentials_until(place: SecureFolder, robot: str, common_name: str, end: datetime) -> Credentials:
    """Credentials by the robot's authority that end at a time of the day."""
    authority = x509.load_pem_x509_certificate(place.authority_certificate.read_bytes())
    signer = serialization.load_pem_private_key(place.authority_key.read_bytes(), None)
    key = ec.generate_private_key(ec.SECP256R1())
    certificate = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)]))
        .issuer_name(authority.subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(datetime(1970, 1, 2, tzinfo=UTC))
        .not_valid_after(end)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH]), critical=False)
        .sign(signer, hashes.SHA256())
    )
    form = (serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    return Credentials(
        name=NAME,
        role="operator",
        robot=robot,
        until=end.date().isoformat(),
        key=key.private_bytes(serialization.Encoding.PEM, *form).decode(),
        certificate=certificate.public_bytes(serialization.Encoding.PEM).decode(),
        authority=place.authority_certificate.read_text(),
    )
