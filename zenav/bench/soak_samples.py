# SPDX-License-Identifier: Apache-2.0
"""What grows in a long run: memory, file handles, threads, dropped messages and their age, for each service."""

import gc
import statistics
import sys
import types
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shared.messages import Health

MAX_GROWTH = 0.05  # of a service's memory after the warm-up
MAX_AGE_GROWTH_S = 0.05  # of the age at which a service handles a message: a queue that grows
MIN_STATE_MB = 1.0  # smaller states are judged together: a list of ten entries that gets one more is no leak
SMALL = "the others"
NO_STATE = (
    type, types.ModuleType, types.FunctionType, types.BuiltinFunctionType, types.CodeType, types.GetSetDescriptorType,
    types.MemberDescriptorType, types.WrapperDescriptorType, types.MethodDescriptorType,
)  # fmt: skip
"""Code, which all instances share."""


@dataclass(frozen=True, slots=True)
class ServiceSample:
    """One service at one time.

    at: s since the start.  life: the process's number; in lockstep how often it was started.
    memory: MB; of a process its share of all the pages that it uses (PSS), in lockstep the objects of its state.
    age: s, the largest between a message's stamp and its handling in the last second.  dropped: messages, so far.
    """

    at: float
    life: int
    memory: float
    n_files: int = 0
    n_threads: int = 0
    age: float = 0.0
    dropped: int = 0


@dataclass(frozen=True, slots=True)
class Growth:
    """One service from the warm-up to the end. memory_*: MB.  age_*: s.  files, threads, dropped: more at the end."""

    name: str
    memory_from: float
    memory_to: float
    files: int
    threads: int
    age_from: float
    age_to: float
    dropped: int

    @property
    def faults(self) -> list[str]:
        """What grew, in words."""
        return [
            *(["memory"] if self.memory_to > (1 + MAX_GROWTH) * self.memory_from else []),
            *(["file handles"] if self.files > 0 else []),
            *(["threads"] if self.threads > 0 else []),
            *(["the age of its messages"] if self.age_to > self.age_from + MAX_AGE_GROWTH_S else []),
            *(["dropped messages"] if self.dropped > 0 else []),
        ]


def process_sample(pid: int, at: float, health: Health | None) -> ServiceSample | None:
    """A process's sample; None where it has ended. health: its newest message, of this process or none."""
    process = Path(f"/proc/{pid}")
    try:
        lines = (process / "smaps_rollup").read_text().splitlines()
        pss = next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
        n_files, n_threads = (sum(1 for _ in (process / part).iterdir()) for part in ("fd", "task"))
    except (OSError, StopIteration):
        return None
    age = max((age for _, _, age in health.rates), default=0.0) if health is not None else 0.0
    dropped = health.dropped if health is not None else 0
    return ServiceSample(
        at=at, life=pid, memory=pss / 1024, n_files=n_files, n_threads=n_threads, age=age, dropped=dropped
    )


def state_mb(service: object) -> float:
    """MB of everything that a service's attributes reach, each object once, without code."""
    seen: set[int] = set()
    waiting, total = [service], 0
    while waiting:
        item = waiting.pop()
        if id(item) in seen or isinstance(item, NO_STATE) or type(item).__module__.startswith("numba"):
            continue
        seen.add(id(item))
        total += sys.getsizeof(item)  # of an array with its values, where they are its own
        waiting.extend(gc.get_referents(item))
        if isinstance(item, np.ndarray) and item.base is not None:
            waiting.append(item.base)  # arrays are not known to the collector
    return total / 1e6


def growths(samples: dict[str, list[ServiceSample]], since: float) -> list[Growth]:
    """What the last life of each service gained after `since` (s).

    Medians of the first and of the last fifth of its samples; services with under ten of them are left out.
    """
    growing = []
    for name, rows in samples.items():
        life = [row for row in rows if row.life == rows[-1].life and row.at >= since]
        n = len(life) // 5
        if n < 2:
            continue
        first, last = _medians(life[:n]), _medians(life[-n:])
        growing.append(
            Growth(
                name=name,
                memory_from=round(first[0], 3),
                memory_to=round(last[0], 3),
                files=round(last[1] - first[1]),
                threads=round(last[2] - first[2]),
                age_from=round(first[3], 4),
                age_to=round(last[3], 4),
                dropped=life[-1].dropped - life[0].dropped,
            )
        )
    return growing


def joined_small(samples: dict[str, list[ServiceSample]]) -> dict[str, list[ServiceSample]]:
    """The samples, those of services with small states as one service's: sums of the same moments."""
    small = [name for name, rows in samples.items() if rows and rows[-1].memory < MIN_STATE_MB]
    together: dict[float, float] = {}
    for name in small:
        for row in samples[name]:
            together[row.at] = together.get(row.at, 0.0) + row.memory
    others = {name: rows for name, rows in samples.items() if name not in small}
    return others | {SMALL: [ServiceSample(at, 0, memory) for at, memory in sorted(together.items())]}


def _medians(rows: list[ServiceSample]) -> tuple[float, float, float, float]:
    """Memory, file handles, threads, age."""
    columns = zip(*((row.memory, float(row.n_files), float(row.n_threads), row.age) for row in rows), strict=True)
    memory, files, threads, age = (statistics.median(column) for column in columns)
    return memory, files, threads, age
