# SPDX-License-Identifier: Apache-2.0
"""Are the packages of the extra `cluster` installed? Only files of zenav/batch import them, late."""

from importlib.util import find_spec

from shared.config import UserError

PACKAGES = "distributed", "fsspec", "s3fs", "aiohttp", "pyarrow", "duckdb"


def require_extra() -> None:
    """Raises UserError, with the command that installs them, where a package of the extra is missing."""
    missing = [name for name in PACKAGES if find_spec(name) is None]
    if missing:
        raise UserError(
            f"work on many recordings needs packages that are not installed: {', '.join(missing)}",
            'pip install "zenav[cluster]"',
        )
