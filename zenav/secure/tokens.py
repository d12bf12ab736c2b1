# SPDX-License-Identifier: Apache-2.0
"""Tokens of members, for programs that can show no certificate: the Foxglove app has a place for an address alone.

A token is 256 random bits. The folder has its SHA-256 only, by the name of the member's certificate. So a token ends
with that certificate: when the member is revoked or renewed, or on its last day.
"""

import json
import secrets
import sys
from hashlib import sha256
from hmac import compare_digest

from shared.config import UserError
from shared.secure_folder import Member, MemberRole, SecureFolder, secure_folder
from zenav.secure.members import today, valid_member

TOKEN_BYTES = 32
MAX_TOKEN = 200  # characters of what a client may give as one


def issue_token(name: str, folder: str) -> None:
    """Prints a new token of a member, once; an older one ends. Raises UserError where the member can have none."""
    place = secure_folder(folder).require()
    token = secrets.token_urlsafe(TOKEN_BYTES)
    with place.locked():
        member = valid_member(place, name)
        if member.role in (MemberRole.SERVICE, MemberRole.ROBOT):
            hint = "a token is for a person: zenav secure add NAME --role viewer"
            raise UserError(f"{name} is a {member.role}", hint)
        kept = {row.common_name for row in place.members() if not row.revoked}
        hashes = {key: value for key, value in _hashes(place).items() if key in kept}
        hashes[member.common_name] = _hash(token)
        place.write(place.tokens_file, json.dumps(hashes, indent=1).encode())
    sys.stdout.write(f"{token}\n")
    sys.stderr.write(f"{name}, {member.role}, until {member.until}; it is not shown again: give it to {name} alone\n")
    sys.stderr.write("in Foxglove, open a Foxglove WebSocket: wss://HOST:8765/?token=TOKEN\n")


def token_member(place: SecureFolder, token: str) -> Member | None:
    """The valid member that a token belongs to. Raises UserError where a list of the folder is damaged."""
    given = _hash(token[:MAX_TOKEN])
    hashes = _hashes(place)
    # every hash is compared, so that the time does not depend on which one fits
    found = [name for name, kept in hashes.items() if compare_digest(kept, given)]
    day = today()
    members = (row for row in place.members() if not row.revoked and row.days_left(day) >= 0)
    return next((row for row in members if row.common_name in found), None)


def _hashes(place: SecureFolder) -> dict[str, str]:
    """Hashes of tokens, by common name."""
    try:
        rows = json.loads(place.tokens_file.read_text())
        return {str(name): str(value).encode("ascii").decode() for name, value in rows.items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, AttributeError):
        raise UserError(f"{place.tokens_file} is no list of tokens", "remove it, and issue the tokens again") from None


def _hash(token: str) -> str:
    return sha256(token.encode()).hexdigest()
