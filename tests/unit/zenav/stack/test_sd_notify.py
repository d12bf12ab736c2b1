# SPDX-License-Identifier: Apache-2.0
"""What systemd hears: sd_notify(3), against a socket as it opens one."""

import os
import socket
import threading

import pytest

from zenav.stack.sd_notify import Notifier


@pytest.fixture(params=["path", "abstract"])
def systemd(request, tmp_path, monkeypatch):
    """systemd's end of the socket; the variables are set as for a service with WatchdogSec=0.4."""
    address = str(tmp_path / "notify") if request.param == "path" else f"@zenav-{os.getpid()}-{tmp_path.name}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(f"\0{address[1:]}" if address.startswith("@") else address)
        listening.settimeout(5)
        monkeypatch.setenv("NOTIFY_SOCKET", address)
        monkeypatch.setenv("WATCHDOG_USEC", "400000")
        monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
        yield listening


def heard(listening):
    listening.setblocking(False)
    lines = []
    while True:
        try:
            lines.append(listening.recv(4096).decode())
        except BlockingIOError:
            return lines


def test_each_word_is_a_datagram(systemd):
    notifier = Notifier()
    notifier.ready()
    notifier.status("9 services run")
    notifier.stopping()
    assert heard(systemd) == ["READY=1", "STATUS=9 services run", "STOPPING=1"]


def test_signs_of_life_come_four_times_a_period_however_often_they_are_asked_for(systemd):
    notifier = Notifier()
    for _ in range(100):
        notifier.alive()
    assert heard(systemd) == ["WATCHDOG=1"]
    threading.Event().wait(notifier.period / 4)
    notifier.alive()
    assert heard(systemd) == ["WATCHDOG=1"]


def test_children_do_not_inherit_the_socket(systemd):
    Notifier()
    assert not {"NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"} & set(os.environ)  # noqa: TID251


def test_a_watchdog_that_is_meant_for_another_process_is_left_alone(systemd, monkeypatch):
    monkeypatch.setenv("WATCHDOG_PID", "1")
    Notifier().alive()
    assert heard(systemd) == []


def test_without_systemd_nothing_is_said(monkeypatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    monkeypatch.setenv("WATCHDOG_USEC", "400000")
    notifier = Notifier()
    notifier.ready()
    notifier.alive()
    assert notifier.period == 0.0


def test_a_socket_that_is_gone_is_no_error(monkeypatch, tmp_path):
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "gone"))
    Notifier().ready()
