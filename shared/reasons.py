# SPDX-License-Identifier: Apache-2.0
"""Why a robot stands: one row for each reason, with the words and the hint that the user reads.

Messages contain the `code`; `REASONS[code]` has the rest. Guard, planner, local control and navigator cannot stop the
robot without one. The texts are published: a change of one changes the bytes of recordings.
"""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Reason:
    """One row. severity: info (normal driving), hold (clears by itself), stop (needs a person), fault (hardware)."""

    code: str
    text: str
    hint: str
    severity: Literal["info", "hold", "stop", "fault"]


# fmt: off
ESTOP           = Reason("estop", "STOP is pressed", "release it: zenav estop --release", "stop")
ESTOP_INPUT     = Reason("estop_input", "the robot's e-stop button is pressed", "pull it out, then: zenav estop --release", "stop")
BUMPER          = Reason("bumper", "a bumper is pressed", "a command that leads away is obeyed at creep speed: drive away by hand; a broken one: zenav teleop --override", "hold")
CLIFF           = Reason("cliff", "a cliff sensor sees no floor", "a command that leads away is obeyed at creep speed: drive away by hand; clean the sensor", "hold")
LEAVING_CONTACT = Reason("leaving_contact", "slowed: the robot leaves what it touched", "nothing to do", "info")
CONTACTS_OLD    = Reason("contacts_old", "bumpers, cliff sensors and e-stop input are silent", "does the board send hardware/contacts? check its cable, or take them out of the robot's file", "hold")
FAULT           = Reason("base_fault", "the base reports a fault", "see base/status; repair it, then: zenav estop --release", "fault")
WHEEL_STUCK     = Reason("wheel_stuck", "a wheel is commanded but does not turn", "free the wheel or check its encoder and motor; then: zenav estop --release", "fault")
ENCODERS_BROKEN = Reason("encoders_broken", "the wheels' encoder counts jump again and again", "check the encoders' cables and power; then: zenav estop --release", "fault")
ENCODERS_JUMP   = Reason("encoders_jump", "the wheels' encoder counts jump", "check the encoders' cables and robot.drive.encoder_wrap; it tries again", "hold")
BAD_STAMPS      = Reason("bad_stamps", "an input's stamps or sequence numbers are wrong", "stamps are ns of this stack's clock and rise with each message: see the detail, and zenav topic hz health", "hold")
BASE_SILENT     = Reason("base_silent", "the base driver is silent", "is base_driver running? zenav doctor", "hold")
WHEEL_ASTRAY    = Reason("wheel_astray", "a wheel does not turn as commanded", "is it blocked, or its motor's direction swapped? zenav calibrate motors; then: zenav estop --release", "fault")
NOT_OBEYED      = Reason("not_obeyed", "both wheels fall behind their commands", "is this computer or the board's line overloaded, or the robot against a wall? it tries again", "hold")
PORT_CLOSED     = Reason("port_closed", "the motion board's port is away", "plug its adapter in, or see base/status for what is wrong", "fault")
BATTERY_EMPTY   = Reason("battery_empty", "the battery is empty", "charge it", "fault")
SENSOR_DEAD     = Reason("sensor_dead", "a range sensor does not answer", "check its cable, or take it out of robot.ranges", "fault")
WRONG_RANGES    = Reason("wrong_ranges", "the board's range sensors are not those of robot.ranges", "set robot.ranges to the sensors that the board has: see base/status", "fault")
BOARD_SILENT    = Reason("board_silent", "the motion board does not answer", "check its cable and power", "fault")
ODOM_OLD        = Reason("odom_old", "odometry is missing or old", "is odometry running? zenav topic hz odom", "hold")
SCAN_OLD        = Reason("scan_old", "the laser scan is missing or old", "is the laser turning? zenav topic hz scan", "hold")
SCAN_UNLIKE     = Reason("scan_unlike", "the scan's beams are not those of robot.laser", "set robot.laser as the laser is, or its driver; guard/status has both numbers", "hold")
SCAN_FROZEN     = Reason("scan_frozen", "the laser repeats one scan", "its driver publishes an old buffer with new stamps: restart it, check its cable", "hold")
SCAN_BLIND      = Reason("scan_blind", "the laser sees nothing where the robot drives", "is it covered, dirty or unplugged? guard/status counts its beams; drive away by hand; in open air set guard.view.min_share to 0", "hold")
SCAN_EMPTY      = Reason("scan_empty", "slowed: nothing returns from where the robot drives", "in halls wider than the laser's range and in open air set guard.view.min_ahead to 0", "info")
NO_SENSOR       = Reason("no_sensor", "slowed: no sensor looks where the robot drives", "turn round, or add a laser or range sensor for that direction to the robot's file", "info")
POSE_OLD        = Reason("pose_old", "the pose on the map is missing or old", "is the mapper running? zenav topic hz pose", "hold")
POSE_LOST       = Reason("pose_lost", "the robot does not know where it is", "drive a few metres by hand, or give its pose: zenav map mode localise --at X Y DEG", "stop")
POSE_JUMPED     = Reason("pose_jumped", "the pose jumped by over 0.5 m", "a new plan to the goal is made; nothing to do", "hold")
COMMAND_OLD     = Reason("command_old", "the command source fell silent", "is local_ctrl running? zenav topic hz cmd/nav", "hold")
NO_COMMAND      = Reason("no_command", "no source commands the robot", "send a goal: zenav goto X Y", "info")
OBSTACLE        = Reason("obstacle", "something is inside the protective field", "clear the way, or drive away by hand", "hold")
NO_REVERSE      = Reason("no_reverse", "this robot may not drive backward", "set robot.drive.max_reverse_speed", "info")
NO_TURN_IN_PLACE = Reason("no_turn_in_place", "this robot may not turn on the spot", "drive while it turns, or set robot.drive.turns_in_place", "info")
OBSTACLE_SLOW   = Reason("obstacle_slow", "slowed: something is near", "nothing to do", "info")
SPEED_ZONE      = Reason("speed_zone", "slowed: a speed zone", "nothing to do; zenav zones list shows it", "info")
ESTOP_RELEASED  = Reason("estop_released", "STOP was released", "send a new goal: releasing never moves the robot", "info")
RIGHT_OF_WAY    = Reason("right_of_way", "the robot waits for another robot that has the right of way", "it goes on by itself; the detail names the other robot", "info")
GIVING_WAY      = Reason("giving_way", "the robot makes way for another robot", "it goes on by itself; the detail names the other robot", "info")
TRAFFIC_OLD     = Reason("traffic_old", "the right of way among the robots is missing or old", "is traffic running? zenav topic hz traffic/right_of_way", "hold")
ROBOT_SILENT    = Reason("robot_silent", "slowed: a robot on this way fell silent", "is its stack running, and its network up? zenav fleet list", "info")
PLAN_OLD        = Reason("plan_old", "the plan is over 2 s old", "is the planner running? zenav topic hz plan", "hold")
NO_PLAN         = Reason("no_plan", "there is no plan yet", "wait for the planner", "hold")
NO_MAP          = Reason("no_map", "there is no map yet", "is the mapper running? zenav topic hz map", "hold")
GOAL_OUTSIDE    = Reason("goal_outside", "the goal lies outside the map", "choose a goal on the map", "info")
GOAL_BLOCKED    = Reason("goal_blocked", "the goal lies in or beside an obstacle", "choose a goal with room for the robot", "info")
GOAL_UNKNOWN    = Reason("goal_unknown", "the goal lies in unknown space", "explore first: zenav explore", "info")
GOAL_KEEP_OUT   = Reason("goal_keep_out", "the goal lies in a keep-out zone", "choose another goal, or take the zone away: zenav zones list", "info")
START_OUTSIDE   = Reason("start_outside", "the robot's pose lies outside the map", "give its pose: zenav map mode localise --at X Y DEG, or load the map of this place", "hold")
START_BLOCKED   = Reason("start_blocked", "the robot stands in an obstacle of the map", "drive it free by hand", "hold")
UNREACHABLE     = Reason("unreachable", "no way leads to the goal", "open a way or choose another goal", "info")
NO_ROOM_TO_TURN = Reason("no_room_to_turn", "no way leads to the goal on arcs that the robot drives", "move it or the goal, take any heading, or set a smaller robot.drive.min_turning_radius", "info")
HEADING_MISSED  = Reason("heading_missed", "the robot arrived with another heading and may not turn on the spot", "the navigator lets it approach again", "hold")
BLOCKED         = Reason("blocked", "no safe way forward right now", "the navigator tries its recoveries", "hold")
NO_WAY_THROUGH  = Reason("no_way_through", "the way turns out to be closed, again and again", "open it wider, or choose another goal", "hold")
NO_PROGRESS     = Reason("no_progress", "the robot has not come closer for a while", "the navigator tries its recoveries", "hold")
MOTION_BLOCKED  = Reason("motion_blocked", "something is in the way of the turn or the straight drive", "clear the way, or drive elsewhere", "info")
MOTION_TOO_LONG = Reason("motion_too_long", "the turn or the straight drive took longer than allowed", "is the robot held or blocked? give it more time", "info")
RECOVERIES_USED = Reason("recoveries_used", "every recovery was tried", "look at the robot and its way", "stop")
NO_FRONTIER     = Reason("no_frontier", "nothing reachable is left to explore", "nothing to do: the map is complete", "info")
CANCELED        = Reason("canceled", "the task was canceled", "send a new goal", "info")
OTHER_MAP       = Reason("other_map", "the map was changed: the task was on another one", "send a new goal", "info")
INTERRUPTED     = Reason("interrupted", "the task was interrupted, as by a restart, and does not go on", "give the task again", "info")
PAUSED          = Reason("paused", "the task is paused", "go on: zenav route --resume", "info")
BY_HAND         = Reason("by_hand", "a person drives the robot by hand", "let go and it goes on; after navigator.leg.hold_time the task ends", "info")
DWELLING        = Reason("dwelling", "the robot stays at a pose of its route", "nothing to do: it goes on by itself", "info")
OVERRIDE        = Reason("override", "the protective field is overridden by hand", "it ends when teleop does, or no longer asks for it", "stop")
BUSY            = Reason("busy", "the service has another request to finish", "try again in a moment", "info")
TOO_LARGE       = Reason("too_large", "the message is too large", "send less at once, or in parts: see the detail for the limit", "info")
NOT_RUNNING     = Reason("not_running", "no service answers", "start the stack: zenav up", "stop")
BAD_REQUEST     = Reason("bad_request", "the request is not valid", "see the detail", "info")
EXPIRED         = Reason("expired", "the order is too old, or is dated in the future", "send it again; the clocks of the sender and of the robot must agree to a second: use NTP", "info")
NO_LINK         = Reason("no_link", "nothing of this robot crosses to a site", "start it with zenav up --site tls/HOST:7449", "info")
NO_SUCH_FILE    = Reason("no_such_file", "there is no recording of that name", "list them: zenav fleet recordings NAME", "info")
NO_SUCH_MAP     = Reason("no_such_map", "there is no saved map of that name", "list them: zenav map load --help", "info")
NO_GRAPH        = Reason("no_graph", "the mapper keeps no pose graph of this map", "tiles alone are saved and loaded all the same; a graph is there after mapping again", "info")
MAP_REFUSED     = Reason("map_refused", "the saved map cannot be taken", "the map in use is untouched; see the detail", "info")
TRANSFER_BROKEN = Reason("transfer_broken", "a part of the map is missing", "the map in use is untouched; do it again", "info")
STARTING        = Reason("starting", "the stack is starting", "wait a moment", "info")
DISK_FULL       = Reason("disk_full", "the disk is full: nothing is recorded", "make room; recording goes on by itself", "info")
NOT_RECORDED    = Reason("not_recorded", "the recording cannot be written", "see the recorder's log; it is tried again", "info")
SERVICE_DIED    = Reason("service_died", "a service died and is being restarted", "see its log", "hold")
# fmt: on

REASONS: dict[str, Reason] = {r.code: r for r in list(globals().values()) if isinstance(r, Reason)}


def reason_text(code: str) -> str:
    """The words of a reason's code; the code itself where it is not in the table."""
    return REASONS[code].text if code in REASONS else code
