# SPDX-License-Identifier: Apache-2.0
"""Definitions that rosbags lacks: services, actions and messages of std_srvs, nav2_msgs, map_msgs and others.

Source: docs.ros.org, nav2_msgs of Humble, Jazzy and Kilted; ros-planning/navigation_msgs, map_msgs;
iRobotEducation/irobot_create_msgs. Constants are left out: neither the wire nor a type's hash has them. A service is
request and response, an action is goal, result and feedback.
"""

POSE_FEEDBACK = """\
geometry_msgs/PoseStamped current_pose
builtin_interfaces/Duration navigation_time
builtin_interfaces/Duration estimated_time_remaining
int16 number_of_recoveries
float32 distance_remaining
"""
THROUGH_FEEDBACK = POSE_FEEDBACK + "int16 number_of_poses_remaining\n"
TO_POSE_GOAL = "geometry_msgs/PoseStamped pose\nstring behavior_tree\n"
THROUGH_GOAL = "geometry_msgs/PoseStamped[] poses\nstring behavior_tree\n"
WAYPOINTS_GOAL = "uint32 number_of_loops\nuint32 goal_index 0\ngeometry_msgs/PoseStamped[] poses\n"
EMPTY_RESULT, ERROR = "std_msgs/Empty result\n", "uint16 error_code\nstring error_msg\n"
WAYPOINT = "uint32 current_waypoint\n"
SPIN_GOAL = "float32 target_yaw\nbuiltin_interfaces/Duration time_allowance\n"
STRAIGHT_GOAL = "geometry_msgs/Point target\nfloat32 speed\nbuiltin_interfaces/Duration time_allowance\n"
UNCHECKED = "bool disable_collision_checks\n"
WAYPOINT_STATUSES = "nav2_msgs/WaypointStatus[] waypoint_statuses\n"
ELAPSED = "builtin_interfaces/Duration total_elapsed_time\n"
TURNED, DRIVEN = "float32 angular_distance_traveled\n", "float32 distance_traveled\n"
Definition = tuple[str, ...]

SERVICES: dict[str, Definition] = {
    "std_srvs/srv/Trigger": ("", "bool success\nstring message\n"),
    "lifecycle_msgs/srv/GetState": ("", "lifecycle_msgs/State current_state\n"),
    "nav2_msgs/srv/SaveMap": (
        "string map_topic\nstring map_url\nstring image_format\nstring map_mode\n"
        "float32 free_thresh\nfloat32 occupied_thresh\n",
        "bool result\n",
    ),
    "nav2_msgs/srv/LoadMap": ("string map_url\n", "nav_msgs/OccupancyGrid map\nuint8 result\n"),
    "nav2_msgs/srv/ClearEntireCostmap": ("std_msgs/Empty request\n", "std_msgs/Empty response\n"),
    "nav2_msgs/srv/ClearCostmapAroundRobot": ("float32 reset_distance\n", "std_msgs/Empty response\n"),
    "nav2_msgs/srv/ClearCostmapExceptRegion": ("float32 reset_distance\n", "std_msgs/Empty response\n"),
    "action_msgs/srv/CancelGoal": (
        "action_msgs/GoalInfo goal_info\n",
        "int8 return_code\naction_msgs/GoalInfo[] goals_canceling\n",
    ),
}

HUMBLE_ACTIONS: dict[str, Definition] = {
    "nav2_msgs/action/NavigateToPose": (TO_POSE_GOAL, EMPTY_RESULT, POSE_FEEDBACK),
    "nav2_msgs/action/NavigateThroughPoses": (THROUGH_GOAL, EMPTY_RESULT, THROUGH_FEEDBACK),
    "nav2_msgs/action/FollowWaypoints": (
        "geometry_msgs/PoseStamped[] poses\n",
        "int32[] missed_waypoints\n",
        WAYPOINT,
    ),
    "nav2_msgs/action/Spin": (SPIN_GOAL, ELAPSED, TURNED),
    "nav2_msgs/action/BackUp": (STRAIGHT_GOAL, ELAPSED, DRIVEN),
    "nav2_msgs/action/DriveOnHeading": (STRAIGHT_GOAL, ELAPSED, DRIVEN),
}
JAZZY_ACTIONS: dict[str, Definition] = {
    "nav2_msgs/action/NavigateToPose": (TO_POSE_GOAL, ERROR, POSE_FEEDBACK),
    "nav2_msgs/action/NavigateThroughPoses": (THROUGH_GOAL, ERROR, THROUGH_FEEDBACK),
    "nav2_msgs/action/FollowWaypoints": (
        WAYPOINTS_GOAL,
        "nav2_msgs/MissedWaypoint[] missed_waypoints\n" + ERROR,
        WAYPOINT,
    ),
    "nav2_msgs/action/Spin": (SPIN_GOAL, ELAPSED + ERROR, TURNED),
    "nav2_msgs/action/BackUp": (STRAIGHT_GOAL, ELAPSED + ERROR, DRIVEN),
    "nav2_msgs/action/DriveOnHeading": (STRAIGHT_GOAL, ELAPSED + ERROR, DRIVEN),
}
KILTED_ACTIONS: dict[str, Definition] = {
    "nav2_msgs/action/NavigateToPose": (TO_POSE_GOAL, ERROR, POSE_FEEDBACK),
    "nav2_msgs/action/NavigateThroughPoses": (
        "nav_msgs/Goals poses\nstring behavior_tree\n",
        ERROR + WAYPOINT_STATUSES,
        THROUGH_FEEDBACK + WAYPOINT_STATUSES,
    ),
    "nav2_msgs/action/FollowWaypoints": (
        WAYPOINTS_GOAL,
        "nav2_msgs/WaypointStatus[] missed_waypoints\n" + ERROR,
        WAYPOINT,
    ),
    "nav2_msgs/action/Spin": (SPIN_GOAL + UNCHECKED, ELAPSED + ERROR, TURNED),
    "nav2_msgs/action/BackUp": (STRAIGHT_GOAL + UNCHECKED, ELAPSED + ERROR, DRIVEN),
    "nav2_msgs/action/DriveOnHeading": (STRAIGHT_GOAL + UNCHECKED, ELAPSED + ERROR, DRIVEN),
}

MESSAGES: dict[str, str] = {
    "map_msgs/msg/OccupancyGridUpdate": (
        "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data\n"
    ),
    "nav2_msgs/msg/MissedWaypoint": "uint32 index\ngeometry_msgs/PoseStamped goal\nuint16 error_code\n",
    "irobot_create_msgs/msg/HazardDetection": "std_msgs/Header header\nuint8 type\n",
    "irobot_create_msgs/msg/HazardDetectionVector": (
        "std_msgs/Header header\nirobot_create_msgs/HazardDetection[] detections\n"
    ),
    "nav2_msgs/msg/WaypointStatus": (
        "uint8 waypoint_status\nuint32 waypoint_index\ngeometry_msgs/PoseStamped waypoint_pose\n"
        "uint16 error_code\nstring error_msg\n"
    ),
}
