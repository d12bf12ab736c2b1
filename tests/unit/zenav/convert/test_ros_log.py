# SPDX-License-Identifier: Apache-2.0
"""ROS bags as logs: topics, frames, clocks and the laser's place."""

from math import cos, pi, sin
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from shared.config import UserError, load_robot
from shared.geometry import Pose2
from shared.types import NS_PER_S
from tests.unit.services.mapper.rooms import ROOM, cast
from tests.unit.zenav.convert.bags import KINDS, BagOf, file_of, small
from zenav.convert.content import Choice
from zenav.convert.export import convert
from zenav.convert.records import LoggedPose, LoggedScan
from zenav.convert.ros_files import MAGICS, read_bag
from zenav.convert.ros_messages import OLD_TF, WANTED, typestore
from zenav.convert.source import read_content, read_log
from zenav.maps.map_files import grid_of

ROOT = Path(__file__).resolve().parents[4]
FIRST = 1_700_000_000 * NS_PER_S + 123_456_789


def scans_of(log):
    return [record for record in log.records if isinstance(record, LoggedScan)]


def read(bag, tmp_path, choice=Choice()):  # noqa: B008  # a choice is a value
    return read_log(bag.write(tmp_path / "bag"), choice)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_bag_gives_the_same_records_whatever_it_is_called(tmp_path, kind):
    path = small(kind).write(tmp_path / "bag")
    for given_path in (path, file_of(path)):
        log = read_log(given_path, Choice())
        scans = scans_of(log)
        assert (len(scans), log.n_bad, log.has_odometry, log.notes) == (8, 0, True, [])
        assert [scan.stamp for scan in scans] == [1_700_000_000 * NS_PER_S + k * NS_PER_S // 5 for k in range(8)]
        assert_allclose(scans[3].ranges, np.float32(2 + 0.1 * np.arange(16) + 0.03))
        assert (scans[3].angle_min, scans[3].angle_increment) == (np.float32(-1.5), np.float32(0.1))
        assert_allclose(as_row(scans[3].odom_from_base), (0.3, 0.03, 0.06), atol=1e-12)
        assert_allclose(
            tuple(as_row(scans[3].odom_from_base.inverse() @ scans[3].odom_from_laser)), (0.2, 0, 0), atol=1e-12
        )
    odd = tmp_path / "no suffix"
    file_of(path).rename(odd)
    assert len(scans_of(read_log(odd, Choice()))) == 8


def as_row(pose):
    return pose.x, pose.y, pose.yaw


def test_a_folder_without_metadata_is_read_file_by_file_and_says_so(tmp_path):
    folder = tmp_path / "parts"
    folder.mkdir()
    for name, kind, first in (("a_0.mcap", "mcap", 0), ("a_1.db3", "sqlite", 60 * NS_PER_S)):
        file_of(small(kind, first=FIRST + first).write(tmp_path / name)).rename(folder / name)
    (folder / "notes.txt").write_text("of the day")
    log = read_log(folder, Choice())
    assert len(scans_of(log)) == 16
    assert any("no metadata.yaml" in note for note in log.notes)


def test_a_folder_that_lacks_one_of_its_files_gives_the_others(tmp_path):
    path = small().write(tmp_path / "bag")
    text = (path / "metadata.yaml").read_text()
    (path / "metadata.yaml").write_text(text.replace("bag.mcap", "gone.mcap"))
    log = read_log(path, Choice())
    assert len(scans_of(log)) == 8
    assert any("gone.mcap" in note for note in log.notes)


def test_every_ros2_lays_out_what_is_read_alike():
    def layouts(store, type_, found):
        fields = store.fielddefs[type_][1]
        found[type_] = fields
        for _, description in fields:
            while description[0].name in ("ARRAY", "SEQUENCE"):
                description = description[1][0]
            if description[0].name == "NAME" and description[1] not in found:
                layouts(store, description[1], found)
        return found

    stores = [get_typestore(store) for store in Stores if store.value.startswith("ros2")]
    assert len(stores) > 5
    for type_ in WANTED - {OLD_TF}:
        mine = layouts(typestore(ros1=False), type_, {})
        assert all(layouts(store, type_, {}) == mine for store in stores)


# --- the laser's place ----------------------------------------------------------------------------------------------


def quaternions():
    return st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.2).map(Rotation.from_quat)


@settings(max_examples=40, deadline=None)
@given(
    x=st.floats(-2, 2), y=st.floats(-2, 2), yaw=st.floats(-pi, pi), upside_down=st.booleans(), split=quaternions(),
    inverted=st.booleans(), increment=st.sampled_from((0.1, -0.1)), backwards=st.booleans(),
)  # fmt: skip
def test_walls_are_where_they_are_however_the_laser_is_mounted(
    tmp_path_factory, x, y, yaw, upside_down, split, inverted, increment, backwards
):
    """The laser sees a made-up room from where it really is; the records must put the walls where the room has them."""
    mount = Rotation.from_euler("zx", (yaw, pi if upside_down else 0.0))
    angles = -1.5 * np.sign(increment) + increment * np.arange(30)
    rays = mount.apply(np.column_stack((np.cos(angles), np.sin(angles), np.zeros(30))))
    robot = Pose2(0.4, 0.3, 0.2)
    at = robot @ Pose2(0.1 * x, 0.1 * y, 0)
    headings = robot.yaw + np.arctan2(rays[:, 1], rays[:, 0])
    ranges = cast(ROOM, np.tile((at.x, at.y), (30, 1)), headings)
    walls = np.column_stack((at.x + ranges * np.cos(headings), at.y + ranges * np.sin(headings)))

    bag = BagOf()
    between = (split.inv() * mount).as_quat(), split.inv().apply((0.1 * x, 0.1 * y, 0.0))  # a bracket, turned anyhow
    bag.tf(FIRST, "base_link", "bracket", (0, 0, 0), split.as_quat(), static=True)
    if inverted:  # published in the other direction: the laser is the bracket's parent in tf
        turn = Rotation.from_quat(between[0]).inv()
        bag.tf(FIRST, "laser", "bracket", -turn.apply(between[1]), turn.as_quat(), static=True)
        del bag.rows[0]
        back = split.inv()
        bag.tf(FIRST, "bracket", "base_link", (0, 0, 0), back.as_quat(), static=True)
    else:
        bag.tf(FIRST, "bracket", "laser", between[1], between[0], static=True)
    bag.odom(FIRST, robot.x, robot.y, robot.yaw)
    bag.odom(FIRST + NS_PER_S, robot.x, robot.y, robot.yaw)
    more = {"time_increment": -1e-3 if backwards else 1e-3}
    bag.scan(FIRST + NS_PER_S // 2, ranges, angles=(angles[0], increment), **more)

    (scan,) = scans_of(read(bag, tmp_path_factory.mktemp("bag")))
    seen = scan.odom_from_laser.yaw + scan.angle_min + scan.angle_increment * np.arange(30)
    found = np.column_stack((np.cos(seen), np.sin(seen))) * scan.ranges[:, None]
    found += (scan.odom_from_laser.x, scan.odom_from_laser.y)
    assert_allclose(found[::-1] if backwards else found, walls, atol=2e-4)
    assert scan.scan_time == pytest.approx(0.029)
    assert scan.stamp == pytest.approx(FIRST + NS_PER_S // 2 - (29_000_000 if backwards else 0), abs=1000)


def test_a_laser_that_looks_at_the_ground_is_refused_unless_another_one_is_level(tmp_path):
    bag = BagOf()
    tilted = Rotation.from_euler("y", 0.8).as_quat()
    bag.tf(FIRST, "base_link", "tilted", (0, 0, 1), tilted, static=True)
    bag.tf(FIRST, "base_link", "laser", (0, 0, 0.2), static=True)
    bag.odom(FIRST, 0, 0, 0)
    for k in range(3):
        bag.scan(FIRST + k * NS_PER_S, [2.0] * 90, topic="/tilted", frame="tilted", angles=(-3, 0.06))
    bag.scan(FIRST, [1.0] * 9)
    path = bag.write(tmp_path / "bag")
    log = read_log(path, Choice())
    assert_allclose(scans_of(log)[0].ranges, 1.0)
    assert any("laser from /scan; there is /tilted too (--topic-scan TOPIC)" in note for note in log.notes)
    with pytest.raises(UserError, match="tilted by 46 degrees") as error:
        read_log(path, Choice(scan="/tilted"))
    assert error.value.hint


def test_without_tf_the_laser_is_taken_to_sit_on_the_axis_and_that_is_said(tmp_path):
    bag = BagOf()
    bag.odom(FIRST, 1, 2, 0.5)
    bag.scan(FIRST, [1.0] * 9)
    log = read(bag, tmp_path)
    assert scans_of(log)[0].odom_from_laser == scans_of(log)[0].odom_from_base
    assert any("no tf leads from base_link to laser" in note for note in log.notes)


def test_a_base_that_tf_does_not_know_gives_way_to_the_one_that_the_laser_hangs_on(tmp_path):
    bag = BagOf()
    bag.tf(FIRST, "base_link", "laser", (0.3, 0, 0), static=True)
    bag.odom(FIRST, 0, 0, 0, frames=("odom", "base_footprint"))
    bag.scan(FIRST, [1.0] * 9)
    log = read(bag, tmp_path)
    assert scans_of(log)[0].odom_from_laser.x == pytest.approx(0.3)
    assert any("base_footprint" in note and "base_link" in note for note in log.notes)


def test_frames_with_a_leading_slash_are_the_same_frames(tmp_path):
    bag = BagOf("ros1")
    bag.tf(FIRST, "/base_link", "/laser", (0.3, 0, 0), static=True)
    bag.odom(FIRST, 0, 0, 0, frames=("/odom", "base_link"))
    bag.scan(FIRST, [1.0] * 9, frame="/laser")
    assert scans_of(read(bag, tmp_path))[0].odom_from_laser.x == pytest.approx(0.3)


# --- odometry -------------------------------------------------------------------------------------------------------


def test_odometry_comes_from_tf_where_there_is_no_topic_and_is_interpolated_at_the_scans(tmp_path):
    bag = BagOf()
    bag.tf(FIRST, "base_footprint", "base_link", (0, 0, 0.1), static=True)
    bag.tf(FIRST, "base_link", "laser", (0.2, 0, 0), static=True)
    for k in range(5):
        yaw = 3.0 + 0.1 * k  # across the place where a heading wraps
        place = (0.5 * k, 0, 0)
        bag.tf(FIRST + k * NS_PER_S, "odom", "base_footprint", place, (0, 0, sin(yaw / 2), cos(yaw / 2)))
        bag.tf(FIRST + k * NS_PER_S, "map", "odom", (9, 9, 0))
    bag.scan(FIRST + 3 * NS_PER_S // 2, [1.0] * 9)
    log = read(bag, tmp_path)
    (scan,) = scans_of(log)
    assert_allclose(as_row(scan.odom_from_base), (0.75, 0, 3.15 - 2 * pi), atol=1e-4)
    poses = [record for record in log.records if isinstance(record, LoggedPose)]
    assert [pose.stamp for pose in poses] == [FIRST + k * NS_PER_S for k in range(5)]
    assert poses[2].w == pytest.approx(0.1, abs=1e-6)
    assert any("odometry from tf: odom to base_footprint" in note for note in log.notes)


def test_a_robot_that_stands_has_odometry_too(tmp_path):
    bag = BagOf()
    bag.tf(FIRST, "base_link", "laser", static=True)
    for k in range(3):
        bag.tf(FIRST + k * NS_PER_S, "odom", "base_link", (1, 2, 0))
    bag.scan(FIRST, [1.0] * 9)
    log = read(bag, tmp_path)
    assert log.has_odometry
    assert as_row(scans_of(log)[0].odom_from_base) == pytest.approx((1, 2, 0))


def test_without_odometry_it_says_that_the_map_is_a_guess(tmp_path):
    bag = BagOf()
    bag.tf(FIRST, "base_link", "laser", static=True)
    bag.scan(FIRST, [1.0] * 9)
    log = read(bag, tmp_path)
    assert not log.has_odometry
    assert any("scans alone" in note for note in log.notes)


def test_wheel_odometry_is_taken_before_truth_and_before_poses_on_the_map(tmp_path):
    bag = BagOf()
    bag.scan(FIRST, [1.0] * 9)
    for k in range(9):
        bag.odom(FIRST + k, 7, 7, 0, topic="/odometry/global", frames=("map", "base_link"))
        bag.odom(FIRST + k, 8, 8, 0, topic="/base_pose_ground_truth")
    bag.odom(FIRST, 1, 2, 0, topic="/wheel/odom")
    path = bag.write(tmp_path / "bag")
    log = read_log(path, Choice())
    assert as_row(scans_of(log)[0].odom_from_base)[:2] == (1, 2)
    assert any("odometry from /wheel/odom" in note and "(--topic-odom TOPIC)" in note for note in log.notes)
    chosen = read_log(path, Choice(odom="odometry/global"))
    assert as_row(scans_of(chosen)[0].odom_from_base)[:2] == (7, 7)
    with pytest.raises(UserError, match="no topic /wheel/odm") as error:
        read_log(path, Choice(odom="/wheel/odm"))
    assert "/wheel/odom" in error.value.hint


def test_of_two_lasers_the_one_that_sees_farther_round_is_taken(tmp_path):
    bag = BagOf()
    bag.odom(FIRST, 0, 0, 0)
    for k in range(5):
        bag.scan(FIRST + k, [1.0] * 9, topic="/camera/scan")
    bag.scan(FIRST, [2.0] * 60, topic="/lidar", angles=(-3, 0.1))
    assert_allclose(scans_of(read(bag, tmp_path))[0].ranges, 2.0)


def test_odometry_of_another_frame_is_brought_to_the_base_that_was_named(tmp_path):
    bag = BagOf()
    bag.tf(FIRST, "base_link", "wheels", (0.5, 0, 0), static=True)
    bag.tf(FIRST, "base_link", "laser", (0.1, 0, 0), static=True)
    bag.odom(FIRST, 2.5, 0, 0, frames=("odom", "wheels"))
    bag.scan(FIRST, [1.0] * 9)
    log = read(bag, tmp_path, Choice(base_frame="base_link"))
    assert as_row(scans_of(log)[0].odom_from_base) == pytest.approx((2.0, 0, 0))
    assert as_row(scans_of(log)[0].odom_from_laser) == pytest.approx((2.1, 0, 0))


# --- clocks and numbers ---------------------------------------------------------------------------------------------


def test_stamps_of_zero_give_way_to_the_times_of_recording(tmp_path):
    bag = BagOf()
    bag.tf(0, "base_link", "laser", (0.2, 0, 0), static=True, received=FIRST)
    for k in range(4):
        bag.odom(FIRST - 50 * NS_PER_S + k * NS_PER_S, 0.1 * k, 0, 0, received=FIRST + k * NS_PER_S)
        bag.scan(0, [1.0] * 9, received=FIRST + k * NS_PER_S)
    log = read(bag, tmp_path)
    assert [scan.stamp for scan in scans_of(log)] == [FIRST + k * NS_PER_S for k in range(4)]
    assert [scan.odom_from_base.x for scan in scans_of(log)] == pytest.approx([0, 0.1, 0.2, 0.3])
    assert any("/scan without stamps" in note for note in log.notes)


def test_two_clocks_give_way_to_the_times_of_recording(tmp_path):
    bag = BagOf()
    for k in range(4):
        bag.odom(FIRST + k * NS_PER_S, 0.1 * k, 0, 0)
        bag.scan((17 + k) * NS_PER_S, [1.0] * 9, received=FIRST + k * NS_PER_S)
    log = read(bag, tmp_path)
    assert [scan.odom_from_base.x for scan in scans_of(log)] == pytest.approx([0, 0.1, 0.2, 0.3])
    assert any("different clocks" in note for note in log.notes)


def test_a_stamp_that_cannot_be_costs_its_message_alone(tmp_path):
    bag = BagOf()
    bag.odom(FIRST, 0, 0, 0)
    for k in range(9):
        bag.scan(FIRST + k * NS_PER_S if k != 4 else FIRST // 2, [1.0] * 9, received=FIRST + k * NS_PER_S)
    log = read(bag, tmp_path)
    assert (len(scans_of(log)), log.n_bad) == (8, 1)


def test_what_is_no_echo_is_nan_and_the_rest_stays(tmp_path):
    bag = BagOf()
    bag.odom(FIRST, 0, 0, 0)
    bag.scan(FIRST, [1.0, np.nan, np.inf, -np.inf, 0.0, -1.0, 31.0, 0.01, 30.0])
    path = bag.write(tmp_path / "bag")
    nan = np.nan
    assert_allclose(scans_of(read_log(path, Choice()))[0].ranges, [1, nan, nan, nan, nan, nan, nan, nan, 30])
    told = next(message for key, message in read_content(path, Choice()).messages if key == "scan")
    assert_allclose(
        told.ranges, np.float32([1, nan, nan, nan, nan, nan, nan, 0.01, 30])
    )  # the guard looks for near ones


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_of_several_echoes_of_a_beam_the_first_is_taken(tmp_path, kind):
    bag = BagOf(kind)
    bag.odom(FIRST, 0, 0, 0)
    bag.echoes(FIRST, [[1.0, 2.0], [], [3.0]])
    assert_allclose(scans_of(read(bag, tmp_path))[0].ranges, [1, np.nan, 3])


@pytest.mark.parametrize("range_max", [0.0, np.inf, np.nan])
def test_a_driver_that_does_not_tell_its_range_loses_no_beam(tmp_path, range_max):
    bag = BagOf()
    bag.odom(FIRST, 0, 0, 0)
    bag.scan(FIRST, [1.0, 42.0, 3.0], range_max=range_max)
    assert_allclose(scans_of(read(bag, tmp_path))[0].ranges, [1, 42, 3])


@pytest.mark.parametrize("angles", [(0.0, 0.0), (0.0, np.nan), (np.inf, 0.1), (0.0, 4.0), (0.0, 1.0)])
def test_a_scan_of_no_angles_is_counted_and_left_out(tmp_path, angles):
    bag = BagOf()
    bag.odom(FIRST, 0, 0, 0)
    bag.scan(FIRST, [1.0] * 9)
    bag.scan(FIRST + 1, [1.0] * 9, angles=angles)
    log = read(bag, tmp_path)
    assert (len(scans_of(log)), log.n_bad) == (1, 1)


# --- what is not there ----------------------------------------------------------------------------------------------


def test_a_bag_without_a_scan_says_what_is_in_it(tmp_path):
    bag = BagOf()
    bag.odom(FIRST, 0, 0, 0)
    with pytest.raises(UserError, match="no LaserScan in it") as error:
        read(bag, tmp_path)
    assert "/odom (nav_msgs/Odometry)" in error.value.hint


def test_the_pose_on_the_map_is_of_its_topic_and_goals_are_none(tmp_path):
    bag = BagOf()
    bag.goal(FIRST, 5, 5, "/goal_pose")
    bag.goal(FIRST + 1, 1, 2, "/robot_pose")
    messages = read_content(bag.write(tmp_path / "bag"), Choice()).messages
    assert [(key, as_row(message.map_from_base)) for key, message in messages] == [("pose", (1, 2, 0))]


def test_the_pose_on_the_map_is_of_tf_where_no_topic_tells_it(tmp_path):
    bag = BagOf()
    for k in range(3):
        bag.tf(FIRST + k * NS_PER_S, "map", "odom", (10, 0, 0))
        bag.tf(FIRST + k * NS_PER_S, "odom", "base_link", (0.5 * k, 0, 0))
    messages = read_content(bag.write(tmp_path / "bag"), Choice()).messages
    poses = [message for key, message in messages if key == "pose"]
    assert [pose.map_from_base.x for pose in poses] == pytest.approx([10, 10.5, 11])
    assert [pose.map_from_odom.x for pose in poses] == pytest.approx([10, 10, 10])


def test_a_pose_tells_what_it_corrects_of_odometry(tmp_path):
    bag = BagOf()
    for k in range(2):
        bag.odom(FIRST + k * NS_PER_S, 4.0 * k, 0, 0.5)
    bag.goal(FIRST + NS_PER_S // 2, 5, 5, "/pose")
    messages = read_content(bag.write(tmp_path / "bag"), Choice()).messages
    pose = next(message for key, message in messages if key == "pose")
    assert as_row(pose.map_from_odom @ Pose2(2, 0, 0.5)) == pytest.approx((5, 5, 0))


@pytest.mark.parametrize("quarters", [0, 1])
def test_the_map_is_the_last_one_of_its_topic_turned_back_and_costmaps_are_none(tmp_path, quarters):
    cells = np.full((30, 40), -1, np.int8)
    cells[3, 5] = 100
    bag = BagOf()
    for k in range(3):
        bag.grid(FIRST + k, cells if k == 2 else np.zeros((9, 9)), (1.0, 2.0, quarters * pi / 2))
        bag.grid(FIRST + 10 + k, np.zeros((5, 5)), (0, 0, 0), topic="/local_costmap/costmap")
    path = bag.write(tmp_path / "bag")
    ((key, update),) = read_content(path, Choice()).messages
    assert (key, update.stamp) == ("map", FIRST + 2)
    convert(path, tmp_path / "out", "map", Choice(), "", False)
    grid = grid_of(tmp_path / "out" / "map.yaml")
    x, y = (5.5 * 0.05, 3.5 * 0.05) if not quarters else (-3.5 * 0.05, 5.5 * 0.05)
    assert grid.cells[grid.cell(1 + x, 2 + y)] == 100
    assert (grid.cells == 100).sum() == 1


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"", "is empty"),
        (b"\0\1\2\3" * 100, "no log that is known"),
        *((magic, r"file\.bag") for magic in MAGICS),
        (b"#ROSBAG V1.2\n" + b"\0" * 100, "another version"),
        (b"\x89MCAP0\r\n" + b"\0" * 100, r"file\.bag"),
        (b"SQLite format 3\x00" + b"\0" * 100, r"file\.bag"),
    ],
)
def test_what_is_no_bag_is_refused_in_a_line_with_its_hint(tmp_path, content, what):
    path = tmp_path / "file.bag"
    path.write_bytes(content)
    with pytest.raises(UserError, match=what) as error:
        read_log(path, Choice())
    assert "\n" not in error.value.what
    assert error.value.hint


def test_a_folder_without_a_bag_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("of the day")
    with pytest.raises(UserError, match="a folder without a bag"):
        read_bag(tmp_path, WANTED)


def test_a_recording_of_the_stack_is_a_log_too():
    log = read_log(ROOT / "tests" / "replay" / "recordings" / "driving.mcap", Choice())
    assert len(scans_of(log)) > 50
    assert log.has_odometry
    assert scans_of(log)[0].scan_time > 0
    mount = scans_of(log)[0].odom_from_base.inverse() @ scans_of(log)[0].odom_from_laser
    assert as_row(mount) == pytest.approx(as_row(load_robot("x80sv").robot.laser.mount), abs=1e-9)
