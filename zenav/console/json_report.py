# SPDX-License-Identifier: Apache-2.0
"""The JSON file of `--out`."""

import json
import sys
from pathlib import Path
from typing import Any

from shared.config import UserError


def check_writable(out: Path | None) -> None:
    """Looks, before hours of measuring, whether the report can be written. Raises UserError where it cannot."""
    if out is None:
        return
    there = out.exists()
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with out.open("a"):
            pass
        if not there:
            out.unlink()
    except OSError as error:
        raise UserError(f"cannot write {out}: {error.strerror}", "choose another --out") from None


def write_report(out: Path | None, report: dict[str, Any]) -> None:
    """Writes the report as JSON. Raises UserError where the file refuses."""
    if out is None:
        return
    try:
        out.write_text(json.dumps(report, indent=2) + "\n")
    except OSError as error:
        raise UserError(f"cannot write {out}: {error.strerror}", "choose another --out") from None
    sys.stderr.write(f"{out}\n")
