# SPDX-License-Identifier: Apache-2.0
"""Are the packages of an extra installed? Only files of zenav/batch import them, late."""

from importlib.util import find_spec

from shared.config import UserError

EXTRAS = {
    "upload": ("fsspec", "s3fs"),
    "cluster": ("distributed", "fsspec", "s3fs", "aiohttp", "pyarrow", "duckdb"),
}


def require_extra(extra: str = "cluster") -> None:
    """Raises UserError, with the command that installs them, where a package of the extra is missing."""
    missing = [name for name in EXTRAS[extra] if find_spec(name) is None]
    if missing:
        raise UserError(
            f"work on many recordings needs packages that are not installed: {', '.join(missing)}",
            f'pip install "zenav[{extra}]"',
        )


def has_parquet() -> bool:
    """Whether Parquet can be read and written here: a robot that only uploads needs none."""
    return find_spec("pyarrow") is not None
