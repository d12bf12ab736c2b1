# SPDX-License-Identifier: Apache-2.0
"""What the app calls: STOP goes out whatever another call waits for."""

import json
import threading
from types import SimpleNamespace

from shared.messages import GuardState, GuardStatus
from zenav.foxglove.app import App

LIMIT_S = 10.0


class FakeClient:
    """A client of a guard that confirms STOP, and a release only when the test lets it."""

    def __init__(self):
        self.orders, self.is_releasing, self.may_confirm = [], threading.Event(), threading.Event()

    def now(self):
        return 1

    def age(self, topic):
        return 0.0

    def publish(self, publication):
        self.orders.append(publication.message.pressed)

    def wait(self, topic, holds, timeout):
        status = GuardStatus(1, GuardState.STOPPED, "", "estop", "", 0.0)
        if holds(status):
            return status
        self.is_releasing.set()
        assert self.may_confirm.wait(LIMIT_S)
        return GuardStatus(2, GuardState.HOLD, "", "estop_released", "", 0.0)


def test_stop_does_not_wait_for_a_release_that_no_guard_confirms():
    client = FakeClient()
    app = App(client, lambda line, is_error: None, lambda topic: None)
    handlers = {service.name: service.handler for service in app.services()}
    replies = {}

    def call(name):
        replies[name] = json.loads(handlers[name](SimpleNamespace(payload=b"{}", client_id=1)))

    calls = [threading.Thread(target=call, args=(name,)) for name in ("/estop_release", "/estop")]
    try:
        calls[0].start()
        assert client.is_releasing.wait(LIMIT_S)
        calls[1].start()
        calls[1].join(LIMIT_S / 2)
        assert replies == {"/estop": {"success": True, "message": "STOP is pressed"}}
        assert client.orders == [False, True]
    finally:
        client.may_confirm.set()
        for thread in calls:
            thread.join()
        app.close()
