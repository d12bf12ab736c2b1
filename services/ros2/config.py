# SPDX-License-Identifier: Apache-2.0
"""Settings of the ROS 2 bridge."""

import re
from dataclasses import replace
from typing import Literal

from pydantic import Field, field_validator

from services.ros2.ros_format import DdsBridgeFormat, RmwZenohFormat, RosFormat
from services.ros2.ros_types import Distro
from shared.config import Section
from shared.ports import PortConfig
from shared.ros_messages import RosFrames

NAME = r"[A-Za-z_][A-Za-z0-9_]*"
REMAP = re.compile(rf"(/{NAME})+:=(/{NAME})+")


class FrameConfig(Section):
    """Names of the frames in ROS, by REP 105."""

    map: str = Field("map", min_length=1, description="frame of the map")
    odom: str = Field("odom", min_length=1, description="frame of dead reckoning")
    base: str = Field("base_link", min_length=1, description="frame of the robot")
    laser: str = Field("laser", min_length=1, description="frame of the laser")


class RouterTlsConfig(Section):
    """TLS to the router, where it is tls/HOST:PORT. Files are PEM."""

    ca: str = Field("", description="certificate of the authority that signed the router's; empty: public authorities")
    certificate: str = Field("", description="our own certificate, where the router asks for one")
    key: str = Field("", description="the key of our own certificate, without a passphrase")
    verify_name: bool = Field(True, description="the router's certificate must have the host of its address")


class Ros2Config(Section):
    """The ROS 2 bridge."""

    port: PortConfig = Field(
        PortConfig(),
        description="zenoh://tcp/HOST:7447 or zenoh://tls/HOST:7447, the router of the ROS 2 nodes; empty: no bridge",
    )
    tls: RouterTlsConfig = RouterTlsConfig()
    domain: int = Field(0, ge=0, le=232, description="ROS_DOMAIN_ID of the nodes")
    distro: Distro = Field(Distro.JAZZY, description="distribution of the nodes: humble, jazzy or kilted")
    bridge: Literal["rmw_zenoh", "dds"] = Field(
        "rmw_zenoh", description="what the nodes use: rmw_zenoh, or DDS with zenoh-bridge-ros2dds beside them"
    )
    namespace: str = Field(
        "", pattern=rf"^(/{NAME})*$", description="as /robot1, before the names of topics, services and actions"
    )
    node: str = Field("zenav", pattern=rf"^{NAME}$", description="name of the bridge's node")
    drives: bool = Field(
        False, description="the robot is one with ROS 2: its /scan and odometry come in, and /cmd_vel goes out"
    )
    odometry: Literal["odom", "tf"] = Field(
        "odom", description="of the robot that is driven: its /odom, or its /tf where odometry is only there"
    )
    imu: bool = Field(
        False, description="whether /imu of the robot that is driven comes in, for its heading; its mount is robot.imu"
    )
    remap: tuple[str, ...] = Field((), description="other names of topics and services, as /scan:=/base_scan")
    frames: FrameConfig = FrameConfig()
    teleop_hold: float = Field(
        0.3, ge=0.1, le=1, description="s after the last message of /cmd_vel at which the robot gets zero"
    )
    map_interval: float = Field(1.0, ge=0.1, le=60, description="s between two messages of /map, at least")

    @field_validator("remap")
    @classmethod
    def _check_remap(cls, rules: tuple[str, ...]) -> tuple[str, ...]:
        for rule in rules:
            if not REMAP.fullmatch(rule):
                raise ValueError(f"{rule!r} is no rule as /scan:=/base_scan")
        return rules

    @property
    def ros_format(self) -> RosFormat:
        """The format of the nodes' keys."""
        return DdsBridgeFormat() if self.bridge == "dds" else RmwZenohFormat(self.domain, self.namespace, self.node)

    @property
    def ros_frames(self) -> RosFrames:
        """The names of the frames."""
        return RosFrames(self.frames.map, self.frames.odom, self.frames.base, self.frames.laser)

    @property
    def stack_frames(self) -> RosFrames:
        """The names in the stack's own messages: a robot that is driven has its own `odom`, which differs."""
        frames = self.ros_frames
        return replace(frames, odom=f"zenav_{frames.odom}") if self.drives else frames

    def name(self, name: str) -> str:
        """The name in ROS of one of our topics, services and actions: remapped, below the namespace."""
        name = name.partition(" ")[0]  # of two types under one name
        rules = dict(rule.split(":=") for rule in self.remap)
        action, separator, part = name.partition("/_action/")
        renamed = rules.get(action)
        if renamed is not None:
            return renamed + separator + part
        return name if name in GLOBAL_NAMES else self.namespace + name


GLOBAL_NAMES = frozenset(("/tf", "/tf_static", "/clock", "/rosout", "/diagnostics"))
"""Names that ROS nodes use without a namespace."""
