# SPDX-License-Identifier: Apache-2.0
"""The role that each frame, request and operation of a page needs at least. One table; a role includes those before it.

The roles of users of the page and of members of a robot (shared/access_rules.py) are the same.
"""

from collections.abc import Mapping
from enum import StrEnum

from shared import requests
from shared.settings import BY_NAME


class Role(StrEnum):
    """What a user may do, in rising order."""

    VIEWER = "viewer"  # sees everything, and may press STOP
    OPERATOR = "operator"  # drives and gives goals
    ADMIN = "admin"  # also replaces and deletes what is saved


RANK = {role: rank for rank, role in enumerate(Role)}

ROUTE_ROLES = {
    "map_download": Role.VIEWER,
    "map_upload": Role.OPERATOR,  # as map_save
    "recording_download": Role.OPERATOR,  # gigabytes on the link that the robot is driven by
}
"""Downloads and uploads of pages over HTTP."""

FRAME_ROLES = {
    "want": Role.VIEWER,
    "name": Role.VIEWER,
    "ping": Role.VIEWER,
    "stop": Role.VIEWER,
    "stop_all": Role.VIEWER,  # as each STOP
    "let_go": Role.VIEWER,
    "ask": Role.VIEWER,  # and the role of the request
    "do": Role.VIEWER,  # and the role of the operation
    "teleop": Role.OPERATOR,
    "release": Role.OPERATOR,
}

REQUEST_ROLES = {
    requests.NAVIGATE.key: Role.OPERATOR,
    requests.EXPLORE.key: Role.OPERATOR,
    requests.CANCEL.key: Role.OPERATOR,
    requests.PAUSE.key: Role.OPERATOR,
    requests.OVERRIDE.key: Role.OPERATOR,
    requests.SET_ZONES.key: Role.OPERATOR,
    requests.START_MAP.key: Role.OPERATOR,
    requests.EDIT_MAP.key: Role.OPERATOR,
    requests.WATCH.key: Role.OPERATOR,
    requests.WATCH_GRAPH.key: Role.OPERATOR,
    requests.WATCH_LINK.key: Role.VIEWER,
    requests.FAULT.key: Role.ADMIN,
}

TOOL_REQUEST_ROLES = {
    requests.SPIN.key: Role.OPERATOR,
    requests.DRIVE_STRAIGHT.key: Role.OPERATOR,
    requests.CLEAR_COSTMAPS.key: Role.OPERATOR,
    requests.WATCH_GLOBAL_COSTMAP.key: Role.OPERATOR,
    requests.FETCH_MAP.key: Role.VIEWER,
    requests.LOAD_MAP.key: Role.OPERATOR,
    requests.GIVE_MAP.key: Role.OPERATOR,
    requests.NAME_MAP.key: Role.OPERATOR,
    requests.LIST_RECORDINGS.key: Role.VIEWER,
    requests.FETCH_RECORDING.key: Role.OPERATOR,  # as recording_download
    requests.SET.key: Role.ADMIN,  # Zenoh's access rules do not see which setting; a page's operation does
}
"""Requests of tools alone: a page asks for an operation."""

OPERATION_ROLES = {
    "maps": Role.VIEWER,
    "places": Role.VIEWER,
    "recordings": Role.VIEWER,
    "settings": Role.VIEWER,
    "replay_open": Role.VIEWER,
    "replay_at": Role.VIEWER,
    "map_save": Role.OPERATOR,
    "map_load": Role.OPERATOR,
    "place_set": Role.OPERATOR,
    "place_delete": Role.OPERATOR,
    "set_pose": Role.OPERATOR,
    "recording_mark": Role.OPERATOR,
    "setting_set": Role.OPERATOR,  # of a limit: Role.ADMIN, see operation_role
    "map_rename": Role.ADMIN,
    "map_delete": Role.ADMIN,
    "recording_delete": Role.ADMIN,
}
"""What the page's tools do (zenav/page)."""


def operation_role(op: str, arguments: Mapping[str, object]) -> Role:
    """The role that an operation with these arguments needs at least: a limit of speed is set by an admin only."""
    row = BY_NAME.get(str(arguments.get("name"))) if op == "setting_set" else None
    return Role.ADMIN if row is not None and row.is_limit else OPERATION_ROLES[op]


def may(role: Role, needed: Role | None) -> bool:
    """Whether a role suffices; nothing suffices where a table has no row (None)."""
    return needed is not None and RANK[role] >= RANK[needed]
