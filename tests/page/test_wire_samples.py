# SPDX-License-Identifier: Apache-2.0
"""The bytes that the page's own tests decode are those of the codec, and the page's array fields those of messages."""

import json
import re
from pathlib import Path
from typing import get_origin

import numpy as np

from shared.codec import decode, fields_of
from shared.topics import topic_of
from tests.page.wire_samples import FILE, samples

MESSAGE_TYPES = Path(__file__).resolve().parents[2] / "web" / "src" / "message_types.ts"


def test_the_samples_are_what_the_codec_makes():
    assert json.loads(FILE.read_text()) == samples(), "run: python -m tests.page.wire_samples"


def test_every_sample_is_valid():
    for key, text in samples().items():
        decode(topic_of(key).type, bytes.fromhex(text))


def test_the_page_knows_every_array_of_the_messages_that_it_reads():
    text = MESSAGE_TYPES.read_text()
    keys = re.findall(r'^  "?([a-z/]+)"?: [A-Z]\w+;$', text.split("interface MessageOf")[1].split("}")[0], re.MULTILINE)
    assert "scan" in keys
    table = text.split("const ARRAYS")[1]
    for key in keys:
        arrays = {f.name for f in fields_of(topic_of(key).type) if get_origin(f.kind) is np.ndarray}
        row = re.search(rf'^  "?{key}"?: {{(.*)}},$', table, re.MULTILINE)
        assert arrays == set(re.findall(r"(\w+): \"", row[1] if row else "")), key
