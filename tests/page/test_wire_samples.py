# SPDX-License-Identifier: Apache-2.0
"""The bytes that the page's own tests decode are those of the codec."""

import json

from shared.codec import decode
from shared.topics import topic_of
from tests.page.wire_samples import FILE, samples


def test_the_samples_are_what_the_codec_makes():
    assert json.loads(FILE.read_text()) == samples(), "run: python -m tests.page.wire_samples"


def test_every_sample_is_valid():
    for key, text in samples().items():
        decode(topic_of(key).type, bytes.fromhex(text))
