# SPDX-License-Identifier: Apache-2.0
"""Kernels are compiled once for each form of a configuration, and again where the code changed."""

import os
import subprocess
import sys

import pytest

from shared.config import UserError, configured
from shared.robot_files import robot_files
from zenav.stack import warm as module
from zenav.stack.kernel_stamp import CodeDigest, cache_lock, clear_stale, code_digest, read_stamp, write_stamp
from zenav.stack.service_loader import build_service
from zenav.stack.warm import WITH_KERNELS, Times, built_in_robots, n_kernels, tasks_for, warm, warm_first


def keys(robot="x80sv", *settings, services=WITH_KERNELS):
    return {task.service: task.key for task in tasks_for(robot, list(settings), services)}


@pytest.fixture
def compiled(tmp_path, monkeypatch):
    """What would be compiled, by call; the cache is an empty folder."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    calls = []

    def work(due, times, show):
        calls.append([task.service for task in due])
        times.kernels["shared.some.kernel"] += 1.0
        show(times)

    monkeypatch.setattr(module, "_work", work)
    return calls


def test_services_without_kernels_need_no_warming():
    assert tasks_for("x80sv", [], ["recorder", "guard", "odometry"]) == []


def test_values_do_not_matter_but_what_they_switch_on_does():
    usual = keys()
    assert keys("x80sv", "robot.drive.max_speed=0.5", "sim.seed=7", "robot.name=other") == usual
    dwa = keys("x80sv", "local_ctrl.controller=dwa")
    assert {name for name in usual if dwa[name] != usual[name]} == {"local_ctrl"}
    arcs = keys("x80sv", "robot.drive.min_turning_radius=0.5", "robot.drive.turns_in_place=false")
    assert arcs["planner"] != usual["planner"]
    assert keys("x80sv", "sim.world=room")["sim"] != usual["sim"]  # a world of a map has kernels of its own
    port = keys("x80sv", "base_driver.port.device=/dev/ttyUSB0")["base_driver"]
    assert port != keys("x80sv", "base_driver.port.device=''")["base_driver"]
    assert port == keys("x80sv", "base_driver.port.device=/dev/ttyUSB1")["base_driver"]


def test_what_a_wheel_brings_kernels_for_is_each_built_in_robot_in_forms_that_its_base_driver_takes():
    robots = built_in_robots()
    assert {name for name, _ in robots} == set(robot_files())
    assert any(settings for _, settings in robots), "with a board on a port"
    for name, settings in robots:
        file = configured(name, settings)
        build_service("base_driver", file, file.robot)


def test_a_configuration_is_compiled_once(compiled, capsys):
    for _ in range(2):
        warm_first("x80sv", [], ["planner", "navigator"])
    assert compiled == [["planner", "navigator"]]
    assert capsys.readouterr().err.count("compiling kernels for this machine, once") == 1
    warm_first("x80sv", [], ["planner", "navigator", "local_ctrl"])
    assert compiled[1:] == [["local_ctrl"]]


def test_what_is_compiled_again_is_removed_first(compiled, tmp_path):
    tasks = tasks_for("x80sv", [], ["planner"])
    warm(tasks)
    kernel = tmp_path / "cache" / "a.nbc"
    kernel.touch()
    warm(tasks)
    assert kernel.exists()
    warm(tasks, again=True)
    assert not kernel.exists()
    assert compiled == [["planner"]] * 2


def test_a_configuration_whose_compilation_failed_is_tried_again(compiled, monkeypatch):
    def fail(due, times, show):
        raise RuntimeError

    tasks = tasks_for("x80sv", [], ["planner"])
    with monkeypatch.context() as patch:
        patch.setattr(module, "_work", fail)
        with pytest.raises(RuntimeError):
            warm(tasks)
    warm(tasks)
    assert compiled == [["planner"]]


def test_a_worker_that_fails_ends_the_command_and_names_the_service(tmp_path, monkeypatch, capfd):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    (task,) = tasks_for("x80sv", [], ["base_driver"])
    with pytest.raises(RuntimeError, match="base_driver"):
        module._work([module.Task("base_driver", "x80sv", (5,), task.key)], Times(), lambda times: None)
    assert "Traceback" in capfd.readouterr().err


def test_a_configuration_that_a_worker_refuses_is_one_line(tmp_path, monkeypatch, capfd):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    (task,) = tasks_for("x80sv", [], ["base_driver"])
    with pytest.raises(UserError, match="there is no robot no_such_robot"):
        module._work([module.Task("base_driver", "no_such_robot", (), task.key)], Times(), lambda times: None)
    assert not capfd.readouterr().err


def test_a_worker_says_what_it_compiled(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    times, shown = Times(), []
    port = ["base_driver.port.device=/dev/null"]
    module._work(tasks_for("x80sv", port, ["base_driver"]), times, lambda times: shown.append(len(times.kernels)))
    assert set(times.services) == {"base_driver"}
    assert times.kernels["shared.drrobot._crc"] > 0
    assert shown[-1] == len(times.kernels) <= n_kernels({"base_driver"})
    assert list(tmp_path.rglob("*.nbc"))


def test_the_module_is_the_command_that_makes_and_the_image_call(tmp_path):
    every = [task.key for robot, settings in module.ROBOTS for task in tasks_for(robot, settings, WITH_KERNELS)]
    write_stamp(tmp_path, code_digest(), set(every))
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}  # noqa: TID251
    command = [sys.executable, "-m", "zenav.stack.warm"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.stdout == "0 kernels compiled in 0.0 s\n", done.stderr


def test_a_cache_that_cannot_be_written_is_told_with_a_hint(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot keep compiled kernels") as error, cache_lock(tmp_path / "file" / "x"):
        pass
    assert "NUMBA_CACHE_DIR" in error.value.hint


def test_a_stamp_of_other_kernels_clears_the_cache(tmp_path):
    for name in ("a.nbi", "a.nbc", "keep.py"):
        (tmp_path / name).touch()
    old, new = CodeDigest("old", "s"), CodeDigest("new", "s")
    write_stamp(tmp_path, old, {"mapper"})
    assert not clear_stale(tmp_path, old)
    assert read_stamp(tmp_path, old) == {"mapper"}
    assert read_stamp(tmp_path, new) == set()
    assert clear_stale(tmp_path, new)
    assert not (tmp_path / "a.nbc").exists()
    assert (tmp_path / "keep.py").exists()
    assert read_stamp(tmp_path, new) == read_stamp(tmp_path, old) == set()


def test_services_that_may_call_kernels_otherwise_are_warmed_again_with_the_kernels_that_there_are(tmp_path):
    (tmp_path / "a.nbc").touch()
    write_stamp(tmp_path, CodeDigest("k", "old"), {"mapper"})
    assert read_stamp(tmp_path, CodeDigest("k", "new")) == set()
    assert not clear_stale(tmp_path, CodeDigest("k", "new"))
    assert (tmp_path / "a.nbc").exists()


@pytest.mark.parametrize("damaged", ["", "d5fd73", "[]", '{"code": ["x", "y"]}', '{"code": "x", "warmed": []}'])
def test_a_damaged_stamp_is_that_of_other_code(tmp_path, damaged):
    (tmp_path / ".kernels").write_text(damaged)
    assert read_stamp(tmp_path, CodeDigest("x", "y")) == set()
    assert clear_stale(tmp_path, CodeDigest("x", "y"))


def test_the_digest_tells_files_with_kernels_from_those_that_call_them(tmp_path):
    for package in ("services", "shared", "zenav"):
        (tmp_path / package).mkdir()
    kernel, caller, tool = (tmp_path / name for name in ("shared/a.py", "services/b.py", "zenav/c.py"))
    kernel.write_text("import numba\n@njit\ndef f(): ...\n")
    first = code_digest(tmp_path)
    tool.write_text("x = 1\n")
    assert code_digest(tmp_path) == first
    caller.write_text("f()\n")
    second = code_digest(tmp_path)
    assert second.kernels == first.kernels
    assert second.sources != first.sources
    kernel.write_text("import numba\n@njit\ndef g(): ...\n")
    assert code_digest(tmp_path).kernels != first.kernels
