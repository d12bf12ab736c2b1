# SPDX-License-Identifier: Apache-2.0
"""Noisy copies of a log differ from it in their ranges only."""

import gzip

import numpy as np

from tests.unit.zenav.slam.noisy_logs import write_noisy_logs

LOG = (
    "# a comment\n"
    "ODOM 1.000 2.000 0.5 0.1 0.0 0 1.0 robot 1.0\n"
    "FLASER 3 1.00 2.00 81.91 0.1 0.2 0.3 0.1 0.2 0.3 1.5 robot 1.5\n"
    "ROBOTLASER1 0 -1.57 3.14 1.57 50 0.01 0 3 1.00 2.00 50.00 0 0.1 0.2 0.3 0.1 0.2 0.3 0 0 0 0 0 1.6 robot 1.6\n"
)


def test_ranges_have_noise_and_nothing_else_changes(tmp_path):
    log = tmp_path / "hall.log.gz"
    log.write_bytes(gzip.compress(LOG.encode()))
    (tmp_path / "hall.relations").write_text("1 2 0 0 0\n")
    write_noisy_logs(log, tmp_path / "out", 2)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "hall-1.log.gz", "hall-1.relations", "hall-2.log.gz", "hall-2.relations",
    ]  # fmt: skip
    copies = [gzip.decompress((tmp_path / "out" / f"hall-{k}.log.gz").read_bytes()).decode() for k in (1, 2)]
    assert copies[0] != copies[1]
    for copy in copies:
        words, own = copy.split(" "), LOG.split(" ")
        changed = [k for k, (a, b) in enumerate(zip(words, own, strict=True)) if a != b]
        off = np.array([float(words[k]) - float(own[k]) for k in changed])
        assert [own[k] for k in changed] == ["1.00", "2.00", "1.00", "2.00"]
        assert (np.abs(off) < 0.02).all()
