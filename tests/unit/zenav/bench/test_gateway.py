# SPDX-License-Identifier: Apache-2.0
"""The cost of the gateway: limits over the direct time, and the benchmark itself, short."""

import json

import pytest

from zenav.__main__ import _status
from zenav.bench.gateway import DIRECT, RATE_HZ, LinkLatency, figures

LOCAL, TLS = "a service, with a gateway", "that member, over TLS"


@pytest.mark.parametrize(
    ("local", "tls", "kept"), [(1.9, 3.9, True), (2.1, 3.9, False), (1.9, 4.1, False), (0.5, 0.5, True)]
)
def test_the_limits_are_1_ms_more_than_direct_and_3_over_tls(local, tls, kept):
    p99s = {DIRECT: 1.0, LOCAL: local, TLS: tls}
    report = figures({name: LinkLatency(100, 0, 0.3, p99, 0.01) for name, p99 in p99s.items()}, {})
    assert report["kept"] is kept
    assert [report["links"][name]["limit_ms"] for name in p99s] == [None, 2.0, 4.0]


def test_every_message_arrives_at_a_service_and_at_a_member(tmp_path):
    out = tmp_path / "gateway.json"
    assert _status(["bench", "gateway", "--seconds", "1", "--out", str(out)]) in (0, 1)  # times of a busy computer
    report = json.loads(out.read_text())
    assert len(report["links"]) == 4
    assert all((row["n"], row["lost"]) == (RATE_HZ, 0) for row in report["links"].values())
    assert all(row["pss_mb"] > 0 for row in report["gateway"].values())
