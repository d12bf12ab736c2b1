# SPDX-License-Identifier: Apache-2.0
"""The error that a user can fix. It imports nothing, so that a command that only lists the registry answers at once."""


class UserError(Exception):
    """Something that the user can fix: shown as one line and a `hint:`, never as a traceback."""

    def __init__(self, what: str, hint: str) -> None:
        super().__init__(what)
        self.what, self.hint = what, hint
