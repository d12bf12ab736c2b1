# SPDX-License-Identifier: Apache-2.0
"""What docs/wire.md promises of configurations and refusals."""

import json
import re
from pathlib import Path

import pytest
import zenoh

from shared.codec import Envelope, decode, encode
from shared.reasons import BUSY
from shared.requests import REQUESTS
from shared.topics import SERVICES

PAGE = (Path(__file__).resolve().parents[4] / "docs" / "wire.md").read_text(encoding="utf-8")


def test_the_configurations_to_paste_are_zenoh_s():
    blocks = re.findall(r"```json\n(.*?)```", PAGE, re.DOTALL)
    peer, client = (zenoh.Config.from_json5(block) for block in blocks)
    assert json.loads(peer.get_json("listen/endpoints")) == ["tcp/127.0.0.1:17400"]
    assert len(json.loads(peer.get_json("connect/endpoints"))) == len(SERVICES) - 1
    assert json.loads(client.get_json("mode")) == "client"
    for config in (peer, client):
        assert config.get_json("scouting/multicast/enabled") == "false"
        assert config.get_json("transport/shared_memory/enabled") == "false"


@pytest.mark.parametrize("row", REQUESTS, ids=lambda row: row.key)
def test_every_request_is_refused_in_one_shape(row):
    refusal = row.refusal(5, BUSY, "8 wait")
    message, _ = decode(row.reply, encode(refusal, Envelope(row.services[0], "s", 0, 5)))
    assert (message.accepted, message.reason, message.detail) == (False, "busy", "8 wait")
