# SPDX-License-Identifier: Apache-2.0
"""The layout for Foxglove and Lichtblick: map, scan, plan and pose from above, driving by hand, state, log and speeds.

The keys are those of the panels' own settings, as the app exports them.
"""

import json
from typing import Any

SLOW, TURN = 0.3, 0.8  # m/s, rad/s: of the Teleop panel's buttons
TELEOP_RATE = 10  # Hz; commander.py wants more than two


def _button(name: str, text: str, colour: str) -> dict[str, Any]:
    return {"serviceName": name, "requestPayload": "{}", "layout": "vertical", "editingMode": False,
            "buttonText": text, "buttonColor": colour, "timeoutSeconds": 10}  # fmt: skip


def _plotted(*paths: tuple[str, str]) -> dict[str, Any]:
    series = [
        {"value": path, "label": label, "enabled": True, "timestampMethod": "receiveTime"} for path, label in paths
    ]
    return {"paths": series, "isSynced": True, "xAxisVal": "timestamp", "showLegend": True,
            "legendDisplay": "floating", "followingViewWidth": 30}  # fmt: skip


PANELS: dict[str, dict[str, Any]] = {
    "3D!scene": {
        "followMode": "follow-none",
        "followTf": "map",
        "cameraState": {"perspective": False, "distance": 25, "phi": 0, "thetaOffset": 0, "fovy": 45, "near": 0.5,
                        "far": 5000, "target": [0, 0, 0], "targetOffset": [0, 0, 0], "targetOrientation": [0, 0, 0, 1]},
        "topics": {
            "/map": {"visible": True, "colorMode": "rgba-fields"},
            "/debug/costmap": {"visible": False, "colorMode": "rgba-fields"},
            "/debug/rollouts": {"visible": False},
            "/debug/graph": {"visible": False},
            "/scan": {"visible": True, "colorMode": "flat", "flatColor": "#e02020", "pointSize": 4},
            "/plan": {"visible": True, "type": "line", "lineWidth": 0.05, "gradient": ["#20c040ff", "#20c04080"]},
            "/pose": {"visible": True, "axisScale": 0.5},
            "/nav/goal": {"visible": True, "type": "arrow", "color": "#f08000ff", "arrowScale": [0.6, 0.1, 0.1]},
            "/map/zones": {"visible": True},
            "/robot": {"visible": True},
            "/base/cones": {"visible": False},
            "/sim/people": {"visible": True},
        },
        "publish": {"type": "pose", "poseTopic": "/goal", "poseEstimateTopic": "/initialpose",
                    "pointTopic": "/clicked_point", "poseEstimateXDeviation": 0.5, "poseEstimateYDeviation": 0.5,
                    "poseEstimateThetaDeviation": 0.26},
    },
    "Teleop!drive": {
        "topic": "/teleop",
        "publishRate": TELEOP_RATE,
        "upButton": {"field": "linear-x", "value": SLOW},
        "downButton": {"field": "linear-x", "value": -SLOW},
        "leftButton": {"field": "angular-z", "value": TURN},
        "rightButton": {"field": "angular-z", "value": -TURN},
    },
    "CallService!stop": _button("/estop", "STOP", "#c62828"),
    "CallService!release": _button("/estop_release", "Release STOP", "#2e7d32"),
    "CallService!explore": _button("/explore", "Explore", "#1565c0"),
    "CallService!cancel": _button("/cancel", "Cancel", "#6d4c41"),
    "DiagnosticSummary!state": {"topicToRender": "/diagnostics", "minLevel": 0, "sortByLevel": True, "pinnedIds": [],
                                "hardwareIdFilter": ""},
    "StateTransitions!tasks": {"isSynced": True, "paths": [
        {"value": "/nav/status.state", "label": "navigator", "timestampMethod": "receiveTime"},
        {"value": "/guard/status.state", "label": "guard", "timestampMethod": "receiveTime"},
        {"value": "/zenav/pose.state", "label": "pose", "timestampMethod": "receiveTime"},
    ]},
    "RosOut!log": {"topicToRender": "/log", "minLogLevel": 1, "searchTerms": []},
    "Plot!speed": _plotted(
        ("/odom.linear_velocity.x", "v, m/s"),
        ("/odom.angular_velocity.z", "w, rad/s"),
        ("/cmd/vel.v", "commanded v, m/s"),
    ),
    "Plot!health": _plotted(
        ("/health/mapper.cpu", "mapper, share of a core"),
        ("/health/local_ctrl.handler_ms", "local_ctrl, slowest handler, ms"),
        ("/zenav/pose.quality", "quality of the pose"),
    ),
}  # fmt: skip


def _split(direction: str, share: float, first: Any, second: Any) -> dict[str, Any]:
    """share: percent that the first takes."""
    return {"direction": direction, "splitPercentage": share, "first": first, "second": second}


def layout() -> str:
    """The layout as the JSON text that the app imports."""
    buttons = _split(
        "row", 50,
        _split("row", 50, "CallService!stop", "CallService!release"),
        _split("row", 50, "CallService!explore", "CallService!cancel"),
    )  # fmt: skip
    controls = _split("column", 70, "Teleop!drive", buttons)
    status = _split(
        "column", 40, "DiagnosticSummary!state", _split("column", 35, "StateTransitions!tasks", "RosOut!log")
    )
    plots = _split("row", 50, "Plot!speed", "Plot!health")
    arranged = _split("row", 68, _split("column", 75, "3D!scene", plots), _split("column", 40, controls, status))
    whole = {
        "configById": PANELS,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": arranged,
    }
    return json.dumps(whole, indent=2) + "\n"
