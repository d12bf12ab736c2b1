# SPDX-License-Identifier: Apache-2.0
"""`zenav convert`: what is written reads back, also by the tools that the formats are for."""

import gzip
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mcap.reader import make_reader
from numpy.testing import assert_allclose, assert_array_equal
from rosbags.highlevel import AnyReader

from shared import messages as m
from shared.config import Mount, UserError
from shared.geometry import Pose2, wrapped
from shared.messages import LaserScan, Localization, MapUpdate, Odometry, PoseEstimate, Truth
from shared.recording import Recording
from shared.ros_map import read_ros_map
from shared.types import NS_PER_S
from tests.unit.zenav.convert.bags import file_of, small
from zenav.__main__ import _status
from zenav.convert.content import Choice, Content
from zenav.convert.conversion import Conversion
from zenav.convert.export import FORMATS, convert, format_name
from zenav.convert.source import read_content

ROOT = Path(__file__).resolve().parents[4]
ROOM = ROOT / "tests" / "replay" / "recordings" / "driving.mcap"
EVO = Path(sys.executable).parent / "evo_ape"
NAMES = {"ros2": "out", "ros2-sqlite": "out", "ros1": "out.bag", "zenav": "out.mcap", "carmen": "out.log"}

poses = st.builds(Pose2, st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.floats(-3.14, 3.14))
far = 29.0


@st.composite
def contents(draw):
    """A few scans and odometry messages, at stamps of today with every last nanosecond."""
    n = draw(st.integers(1, 4))
    stamps = sorted(
        draw(st.sets(st.integers(1_700_000_000 * NS_PER_S, 1_700_000_009 * NS_PER_S), min_size=n, max_size=n))
    )
    n_beams = draw(st.integers(2, 30))
    increment, scan_time = draw(st.sampled_from((-0.1, 0.0625, 0.2))), draw(st.sampled_from((0.0, 0.1)))
    messages = []
    for stamp in stamps:
        ranges = draw(
            arrays(np.float32, n_beams, elements=st.one_of(st.floats(0.125, far, width=32), st.just(float("nan"))))
        )
        messages.append(
            ("odom", Odometry(stamp, draw(poses), draw(st.floats(-1, 1)), draw(st.floats(-2, 2)), np.arange(9.0)))
        )
        messages.append(("scan", LaserScan(stamp, -1.5, increment, scan_time, 0.0625, 30.0, ranges)))
    mount = Mount(x=draw(st.floats(-2, 2)), y=draw(st.floats(-2, 2)), yaw=draw(st.floats(-3.1, 3.1)))
    return Content(messages, mount)


def far_out():
    """A laser as far from its base as one may be, on a base that has turned."""
    stamp = 1_700_000_000 * NS_PER_S
    odometry = Odometry(stamp, Pose2(0.0, 150.0, 2.0), 0.0, 0.0, np.arange(9.0))
    scan = LaserScan(stamp, -1.5, -0.1, 0.0, 0.0625, 30.0, np.ones(2, np.float32))
    return Content([("odom", odometry), ("scan", scan)], Mount(x=0.0, y=5.0, yaw=0.0))


def looking_back():
    """A laser that looks back, on a base that turns: its heading is pi or -pi, as the last bit falls."""
    messages = []
    for k in range(8):
        stamp = (1_700_000_000 + k) * NS_PER_S
        messages.append(("odom", Odometry(stamp, Pose2(0.1 * k, 0.0, 0.7 * k % 3), 0.0, 0.0, np.arange(9.0))))
        messages.append(("scan", LaserScan(stamp, -1.5, 0.1, 0.0, 0.0625, 30.0, np.ones(2, np.float32))))
    return Content(messages, Mount(x=-0.2, y=0.0, yaw=np.pi))


def written(content, to, folder):
    out = folder / NAMES[to]
    FORMATS[to].write(Conversion(Path(__file__), content, out, "", lambda share: None))
    return out


def near(a, b, tolerance=1e-6):
    assert max(abs(a.x - b.x), abs(a.y - b.y), abs(wrapped(a.yaw - b.yaw))) < tolerance


@pytest.mark.parametrize("to", NAMES)
@settings(max_examples=12, deadline=None)
@given(content=contents())
@example(content=far_out())
@example(content=looking_back())
def test_what_is_written_reads_back(to, content, tmp_path_factory):
    """Ranges to float32, poses to 1e-6, stamps to the nanosecond (in CARMEN logs, to the microsecond)."""
    back = read_content(written(content, to, tmp_path_factory.mktemp("out")), Choice())
    exact = to != "carmen"
    for type_ in (LaserScan, Odometry):
        before = [message for _, message in content.messages if isinstance(message, type_)]
        after = [message for _, message in back.messages if isinstance(message, type_)]
        assert len(after) == len(before)
        assert max(abs(a.stamp - b.stamp) for a, b in zip(after, before)) <= (0 if exact else 1000)
    scans = zip(*([scan for _, scan in c.messages if isinstance(scan, LaserScan)] for c in (content, back)))
    for before, after in scans:
        silent = np.isnan(before.ranges)
        largest = np.nanmax(before.ranges, initial=0)
        kept = ~silent if exact else ~silent & (before.ranges < 0.98 * largest)  # a log's largest range is no echo
        assert np.isnan(after.ranges[silent]).all()
        assert_array_equal(after.ranges[kept], before.ranges[kept])
        assert (after.angle_min, after.angle_increment) == pytest.approx(
            (before.angle_min, before.angle_increment), abs=1e-6
        )
        if exact:
            assert after.scan_time == pytest.approx(before.scan_time, abs=1e-6)
            assert (after.range_min, after.range_max) == pytest.approx((before.range_min, before.range_max))
    tracks = zip(*([m for _, m in c.messages if isinstance(m, Odometry)] for c in (content, back)))
    for before, after in tracks:
        near(after.odom_from_base, before.odom_from_base)
        if exact:
            assert (after.v, after.w) == pytest.approx((before.v, before.w), abs=1e-9)
            assert_allclose(after.covariance, before.covariance)
    near(Pose2(*vars_of(back.mount)), Pose2(*vars_of(content.mount)), 1e-5)


def vars_of(mount):
    return mount.x, mount.y, mount.yaw


@pytest.fixture
def drive():
    """Everything that goes into a ROS bag, in three seconds."""
    messages = []
    for k in range(4):
        stamp = NS_PER_S + k * NS_PER_S
        odom, correction = Pose2(0.5 * k, 0, 0.1 * k), Pose2(1, 2, 0.3)
        messages.append(("odom", Odometry(stamp, odom, 0.5, 0.1, np.eye(3).ravel())))
        messages.append(("scan", LaserScan(stamp, -1.5, 0.1, 0.09, 0.1, 12.0, np.float32([1, np.nan, 3]))))
        estimate = PoseEstimate(stamp, correction @ odom, correction, np.eye(3).ravel(), 0.9, Localization.GOOD)
        messages.append(("pose", estimate))
        cells = np.full((1, 4096), -1, np.int8)
        cells[0, :64] = 100 if k == 3 else 0
        tile = np.array([-1], np.int32)
        messages.append(("map", MapUpdate(stamp, 5, k, 0.05, tile, tile, cells)))
        messages.append(("plan", m.Path(stamp, 1, k, "", np.array([0.0, 1.0]), np.zeros(2), np.zeros(2), 1.0, 1.0)))
        truth = Truth(
            stamp, Pose2(7, 0, 0) @ Pose2(k, 0, 0), Pose2(7, 0, 0), 0, 0, False, 0, 0, *[np.empty(0, np.float32)] * 2
        )
        messages.append(("sim/truth", truth))
    return Content(messages, Mount(x=0.2, y=0.1, yaw=0.5))


@pytest.mark.parametrize("to", ["ros2", "ros2-sqlite", "ros1"])
def test_rosbags_reads_the_exported_bag_with_equal_values(to, drive, tmp_path):
    found = {}
    with AnyReader([written(drive, to, tmp_path)]) as reader:
        for connection, stamp, raw in reader.messages():
            found.setdefault(connection.topic, []).append((stamp, reader.deserialize(raw, connection.msgtype)))
    assert {topic: len(rows) for topic, rows in found.items()} == {
        "/tf_static": 1, "/odom": 4, "/tf": 8, "/scan": 4, "/pose": 4, "/map": 2, "/plan": 4, "/ground_truth": 4,
    }  # fmt: skip
    stamp, scan = found["/scan"][1]
    assert stamp == scan.header.stamp.sec * NS_PER_S + scan.header.stamp.nanosec == 2 * NS_PER_S
    assert_array_equal(scan.ranges, np.float32([1, np.inf, 3]))
    assert (scan.header.frame_id, scan.time_increment) == ("laser", np.float32(0.045))
    odom = found["/odom"][2][1]
    assert (odom.header.frame_id, odom.child_frame_id) == ("odom", "base_link")
    assert (odom.pose.pose.position.x, odom.twist.twist.linear.x) == (1.0, 0.5)
    assert odom.pose.covariance[[0, 7, 35]].tolist() == [1, 1, 1]
    (static,) = found["/tf_static"][0][1].transforms
    assert (static.header.frame_id, static.child_frame_id) == ("base_link", "laser")
    assert (static.transform.translation.x, static.transform.rotation.z) == (0.2, np.sin(0.25))
    frames = {(tf.header.frame_id, tf.child_frame_id) for _, m in found["/tf"] for tf in m.transforms}
    assert frames == {("odom", "base_link"), ("map", "odom")}
    first, last = found["/map"][0][1], found["/map"][1][1]
    assert (last.info.width, last.info.height, last.info.resolution) == (64, 64, np.float32(0.05))
    assert (last.info.origin.position.x, last.info.origin.position.y) == pytest.approx((-3.2, -3.2))
    assert (first.data[0], last.data[0], last.data[64]) == (0, 100, -1)
    assert [p.pose.position.x for p in found["/plan"][0][1].poses] == [0, 1]
    assert [m.pose.position.x for _, m in found["/ground_truth"]] == [0, 1, 2, 3]


def test_late_subscribers_get_the_static_frames(drive, tmp_path):
    with AnyReader([written(drive, "ros2", tmp_path)]) as reader:
        durable = {c.topic: c.ext.offered_qos_profiles[0].durability.name for c in reader.connections}
    assert (durable["/tf_static"], durable["/map"], durable["/scan"]) == (
        "TRANSIENT_LOCAL",
        "TRANSIENT_LOCAL",
        "VOLATILE",
    )


def test_the_mcap_package_reads_the_exported_recording_and_services_replay_it(tmp_path):
    bag = small(n=30).write(tmp_path / "bag")
    out = tmp_path / "run.mcap"
    assert convert(bag, out, "", Choice(), "", False)[0] == {"odom": 30, "scan": 30}
    with out.open("rb") as file:
        kinds = [(channel.topic, channel.message_encoding) for _, channel, _ in make_reader(file).iter_messages()]
    assert sorted(set(kinds)) == [("odom", "msgpack"), ("scan", "msgpack")]
    assert Recording(out).about["converted"] == "bag"
    _status(["replay", str(out), "--through", "mapper", "--out", str(tmp_path / "again.mcap")])
    assert sum(entry.key == "pose" for entry in Recording(tmp_path / "again.mcap").entries()) == 30


def test_a_recording_of_the_stack_becomes_a_bag_that_maps_alike(tmp_path):
    convert(ROOM, tmp_path / "bag", "ros2", Choice(), "", False)
    here, there = (read_content(path, Choice()) for path in (ROOM, tmp_path / "bag"))
    mine = [message for key, message in here.messages if key == "scan"]
    theirs = [message for key, message in there.messages if key == "scan"]
    assert len(mine) == len(theirs) > 50
    assert_array_equal(mine[50].ranges, theirs[50].ranges)
    assert vars_of(there.mount) == pytest.approx(vars_of(here.mount))


@pytest.mark.parametrize("to", ["ros1", "ros2", "tum", "carmen"])
def test_a_stamp_that_no_format_has_costs_its_message_and_is_told(to, tmp_path):
    rows = [("odom", Odometry(stamp, Pose2(), 0.0, 0.0, np.zeros(9))) for stamp in (NS_PER_S, 2 * NS_PER_S, 2**62)]
    source = written(Content(rows), "zenav", tmp_path)
    counts, notes = convert(source, tmp_path / "target", to, Choice(), "", False)
    assert max(counts.values()) == 2
    assert any("1 messages could not be read" in note for note in notes)


def test_a_recording_gives_its_last_map(tmp_path):
    counts, _ = convert(ROOM, tmp_path / "office", "map", Choice(), "", False)
    assert counts["map updates"] > 1
    cells, resolution, *_ = read_ros_map(tmp_path / "office" / "map.yaml")
    assert resolution == 0.05
    assert (cells == 100).sum() > 100
    with pytest.raises(UserError, match="nothing in it for a map's folder"):
        convert(small().write(tmp_path / "bag"), tmp_path / "other", "map", Choice(), "", False)


@pytest.mark.parametrize("to", [to for to in FORMATS if to != "map"])
def test_what_is_written_is_for_its_user_and_group(tmp_path, to):
    source, out = written(looking_back(), "ros1", tmp_path), tmp_path / "new"
    before = os.umask(0)
    try:
        convert(source, out, to, Choice(), "", False)
    finally:
        os.umask(before)
    modes = {path: oct(path.stat().st_mode & 0o777) for path in (out, *out.rglob("*"))}
    assert modes == {path: "0o750" if path.is_dir() else "0o640" for path in modes}


def test_a_map_that_is_written_over_leaves_the_other_files_of_its_folder(tmp_path):
    out = tmp_path / "office"
    convert(ROOM, out, "map", Choice(), "", False)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    for name in ("places.yaml", "zones.yaml", "notes.txt"):
        (out / name).write_bytes(b"kept")
    for name in ("graph.msgpack", "map.pgm"):
        (out / name).write_bytes(b"of another map")
    convert(ROOM, out, "map", Choice(), "", True)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before | dict.fromkeys(
        ("places.yaml", "zones.yaml", "notes.txt"), b"kept"
    )


def test_a_bag_is_not_written_over_by_what_is_read_from_it(tmp_path):
    bag = small().write(tmp_path / "bag")
    before = {path.name: path.read_bytes() for path in bag.iterdir()}
    with pytest.raises(UserError, match="the folder of what is to be read"):
        convert(file_of(bag), bag, "ros2", Choice(), "", True)
    assert {path.name: path.read_bytes() for path in bag.iterdir()} == before


# --- trajectories ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("trajectory", "xs"), [("", [1, 1.48]), ("pose", [1, 1.48]), ("odom", [0, 0.5]), ("truth", [0, 1])]
)
def test_a_trajectory_is_of_the_pose_of_odometry_or_of_the_truth(trajectory, xs, drive, tmp_path):
    out = tmp_path / "a.tum"
    FORMATS["tum"].write(Conversion(ROOM, drive, out, trajectory, lambda share: None))
    rows = np.loadtxt(out)
    assert rows[:2, 0].tolist() == [1, 2]
    assert_allclose(rows[:2, 1], xs, atol=0.01)
    assert_allclose(np.hypot(rows[:, 6], rows[:, 7]), 1)


def test_a_trajectory_that_is_not_there_is_refused_by_what_is(tmp_path):
    bag = small().write(tmp_path / "bag")
    with pytest.raises(UserError, match="no truth in it") as error:
        convert(bag, tmp_path / "a.tum", "", Choice(), "truth", False)
    assert "odom" in error.value.hint
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bag"]


@pytest.mark.skipif(not EVO.exists(), reason="evo is not installed: pip install -r requirements-dev.txt")
def test_evo_takes_the_trajectories(tmp_path):
    for name in ("pose", "odom"):
        convert(ROOM, tmp_path / f"{name}.tum", "", Choice(), name, False)
    home = {"HOME": str(tmp_path), "MPLCONFIGDIR": str(tmp_path), "PATH": "/usr/bin:/bin"}
    traj = subprocess.run(
        [EVO.with_name("evo_traj"), "tum", "pose.tum"],
        cwd=tmp_path,
        env=home,
        capture_output=True,
        text=True,
        check=True,
    )
    n_poses = len(list(Recording(ROOM).entries(["pose"])))
    assert f"{n_poses} poses" in traj.stdout
    ape = subprocess.run(
        [EVO, "tum", "odom.tum", "pose.tum", "-a"], cwd=tmp_path, env=home, capture_output=True, text=True, check=True
    )
    rmse = next(float(line.split()[1]) for line in ape.stdout.splitlines() if "rmse" in line)
    assert rmse < 0.3


# --- the file -------------------------------------------------------------------------------------------------------


def test_nothing_is_written_over_unless_that_is_said(tmp_path):
    bag = small().write(tmp_path / "bag")
    for name in ("out", "out.bag", "out.tum", "out.log.gz"):
        out = tmp_path / name
        convert(bag, out, "", Choice(), "", False)
        with pytest.raises(UserError, match="exists") as error:
            convert(bag, out, "", Choice(), "", False)
        assert "--force" in error.value.hint
        convert(bag, out, "", Choice(), "", True)
    assert len(gzip.decompress((tmp_path / "out.log.gz").read_bytes()).splitlines()) == 2 + 8
    assert len(list(tmp_path.iterdir())) == 5
    assert read_content(tmp_path / "out", Choice()).n_bad == 0


def test_a_folder_of_other_things_is_never_overwritten(tmp_path):
    bag = small().write(tmp_path / "bag")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.png").write_bytes(b"cat")
    with pytest.raises(UserError, match="neither a bag nor a map"):
        convert(bag, tmp_path / "photos", "", Choice(), "", True)
    assert (tmp_path / "photos" / "cat.png").exists()


def test_what_is_read_is_not_written_over(tmp_path):
    bag = small().write(tmp_path / "bag")
    for out in (bag, bag / "bag.mcap"):
        with pytest.raises(UserError, match="what is to be read"):
            convert(bag, out, "ros2", Choice(), "", True)
    assert read_content(bag, Choice()).n_bad == 0


def test_a_writer_that_fails_leaves_what_was_there(tmp_path, monkeypatch):
    bag, out = small().write(tmp_path / "bag"), tmp_path / "out.tum"
    out.write_text("of yesterday\n")

    def full(task):
        task.out.write_text("half")
        raise OSError(28, "No space left on device")

    monkeypatch.setitem(FORMATS, "tum", FORMATS["tum"].__class__("a trajectory", (".tum",), full))
    with pytest.raises(UserError, match="No space left"):
        convert(bag, out, "", Choice(), "", True)
    assert out.read_text() == "of yesterday\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bag", "out.tum"]


@pytest.mark.parametrize("to", FORMATS)
def test_a_full_disk_is_told_in_a_line_and_leaves_nothing(to, tmp_path):
    source = small(n=400).write(tmp_path / "bag") if to != "map" else ROOM
    code = (
        "import resource, signal, sys\n"
        "from zenav.__main__ import main\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"  # stands for a disk with so much room
        "main(['convert', sys.argv[1], sys.argv[2], '--to', sys.argv[3]])\n"
    )
    target = tmp_path / "target"
    target.mkdir()
    ended = subprocess.run(
        [sys.executable, "-c", code, str(source), str(target / "out"), to], capture_output=True, text=True, cwd=ROOT
    )
    assert ended.returncode == 2, ended.stderr
    assert "cannot write" in ended.stderr
    assert "hint: " in ended.stderr
    assert "Traceback" not in ended.stderr
    assert list(target.iterdir()) == []


def test_the_name_tells_the_format(tmp_path):
    told = {"a.mcap": "zenav", "a.bag": "ros1", "a.tum": "tum", "a.log.gz": "carmen", "folder": "ros2"}
    assert {name: format_name("", tmp_path / name) for name in told} == told
    assert format_name("ros2-sqlite", tmp_path / "a.mcap") == "ros2-sqlite"
    for to, name, hint in (("", "a.xyz", "--to"), ("ros3", "a", "did you mean")):
        with pytest.raises(UserError) as error:
            format_name(to, tmp_path / name)
        assert hint in error.value.hint


@pytest.mark.parametrize(
    ("source", "out", "what"),
    [("nothing", "a.tum", "there is no"), ("bag", "no/folder/a.tum", "no folder"), (str(ROOM), "a.mcap", "already")],
)
def test_what_cannot_be_converted_is_told_in_a_line(source, out, what, tmp_path):
    small().write(tmp_path / "bag")
    with pytest.raises(UserError, match=what) as error:
        convert(tmp_path / source, tmp_path / out, "", Choice(), "", False)
    assert error.value.hint


def test_the_help_names_every_format(capsys):
    assert _status(["convert", "--help"]) == 0
    told = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert f"none: {', '.join(FORMATS)}." in told


def test_the_command_says_what_it_wrote(tmp_path, capsys):
    bag = small().write(tmp_path / "bag")
    assert _status(["convert", str(bag), str(tmp_path / "a.bag")]) == 0
    assert "8 /scan" in capsys.readouterr().out
    assert _status(["convert", str(bag), str(tmp_path / "a.bag")]) == 2
    assert "hint: choose another name" in capsys.readouterr().err
