# SPDX-License-Identifier: Apache-2.0
"""Commands that the bridge runs: whatever they write, the bridge gets a result."""

import sys

import pytest

from services.ros2.zenav_command import CommandResult, run_command


@pytest.mark.parametrize(
    ("script", "error"),
    [("printf 'caf\\351 is full' >&2; exit 1", "caf\ufffd is full"), ("exit 3", "status 3")],
    ids=["words that are no text", "no words"],
)
def test_a_command_that_fails_gives_what_can_be_read_of_its_words_or_its_status(tmp_path, monkeypatch, script, error):
    command = tmp_path / "python"
    command.write_text(f"#!/bin/sh\n{script}\n")
    command.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(command))
    assert run_command("map", "save", "office") == CommandResult("", error)
