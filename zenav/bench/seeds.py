# SPDX-License-Identifier: Apache-2.0
"""Numbers of runs as a user writes them: `0-9` or `0,4,7-9`."""

from shared.config import UserError


def seeds_from(text: str, what: str = "seeds") -> list[int]:
    """The numbers of `0-9`, `3` or `0,4,7-9`, in order. Raises UserError on anything else."""
    numbers: list[int] = []
    for part in text.split(","):
        low, dash, high = part.strip().partition("-")
        if not low.isdigit() or (dash and not high.isdigit()):
            raise UserError(f"{text!r} names no {what}", "write 3, 0-9 or 0,4,7-9")
        numbers += range(int(low), int(high or low) + 1)
    if not numbers:
        raise UserError(f"{text!r} names no {what}", "the smaller number comes first, like 0-9")
    return list(dict.fromkeys(numbers))
