# SPDX-License-Identifier: Apache-2.0
"""The command line of a service's process."""

import pytest

from shared.runners.service_start import parser_of


@pytest.mark.parametrize("word", ["debug", "Debug", "DEBUG"])
def test_a_log_level_may_be_written_small(word):
    assert parser_of("mapper").parse_args(["--log", word]).log == "DEBUG"
