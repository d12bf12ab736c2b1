# SPDX-License-Identifier: Apache-2.0
"""Recordings that commands open: the file, and the configuration in it."""

from pathlib import Path

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.error import YAMLError

from shared.config import RobotFile, UserError
from shared.recording import CONFIG, Recording


def open_recording(path: Path) -> Recording:
    """The recording. Raises UserError where there is none."""
    if path.is_dir():
        raise UserError(f"{path} is a folder", f"name a recording in it: {path}/*.mcap")
    return Recording(path)


def recorded_robot_file(recording: Recording) -> RobotFile | None:
    """The configuration that a recording was made with, or None where it holds none. Raises UserError."""
    text = recording.attachments.get(CONFIG)
    if text is None:
        return None
    try:
        tree = YAML(typ="rt").load(text.decode())
    except (YAMLError, UnicodeDecodeError):
        tree = None
    if not isinstance(tree, CommentedMap):
        raise UserError(f"{recording.path}: its configuration is damaged", "name a robot: --robot x80sv")
    return RobotFile(recording.path / CONFIG, tree)
