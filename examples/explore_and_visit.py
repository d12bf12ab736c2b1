# SPDX-License-Identifier: Apache-2.0
"""Explores, then drives to three places in the free space of the map, by the API of docs/api.md.

zenav up --world office                   # in one terminal
python examples/explore_and_visit.py      # in another; ZENAV_STACK and ZENAV_ROBOT as for zenav
"""

import sys

import numpy as np

from zenav.client import connect


def places(points, n):
    """n of the points (x, y), far apart."""
    chosen = [np.zeros(2)]  # where the robot started
    for _ in range(n):
        distances = np.min([np.hypot(*(points - place).T) for place in chosen], axis=0)
        chosen.append(points[np.argmax(distances)])
    return chosen[1:]


def main():
    with connect() as robot:
        robot.on_status(lambda status: status.recovery and print(f"recovery: {status.recovery}"))
        print(f"explored: {robot.explore().text}")
        results = []
        for x, y in places(robot.map().free_points(clearance=0.5), 3):
            results.append(robot.goto(x, y))
            pose = robot.pose()
            print(f"({x:.2f}, {y:.2f}): {results[-1].text}; the robot is at ({pose.x:.2f}, {pose.y:.2f})")
    return 0 if all(result.good for result in results) else 1


if __name__ == "__main__":
    sys.exit(main())
