// SPDX-License-Identifier: Apache-2.0
// The other robots on the map: name, colour, heading and path of each.

import { colorOf, fleet, othersOnMap, selected } from "../fleet";
import { type Pen } from "./pen";

const RADIUS_M = 0.25;
const MIN_RADIUS_PX = 7;

export function drawFleet(pen: Pen): void {
  const { context } = pen;
  for (const robot of othersOnMap.peek()) {
    const color = robot.state === "silent" ? pen.palette.old : colorOf(robot.name, fleet.peek());
    const [xs, ys] = robot.plan;
    if (xs !== undefined && ys !== undefined && xs.length > 1 && robot.state !== "silent") {
      pen.trace(xs.map((x, i) => [x, ys[i]!]));
      pen.stroke(color, 2, [8, 5]);
    }
    const [x, y] = pen.screen([robot.x!, robot.y!]);
    const [tipX, tipY] = pen.screen([robot.x! + Math.cos(robot.yaw!), robot.y! + Math.sin(robot.yaw!)]);
    const radius = Math.max(MIN_RADIUS_PX, RADIUS_M * pen.view.scale);
    const angle = Math.atan2(tipY - y, tipX - x);
    context.beginPath();
    context.arc(x, y, radius, 0, 2 * Math.PI);
    context.fillStyle = color;
    context.fill();
    context.lineWidth = robot.name === selected.peek() ? 4 : 2;
    context.strokeStyle = pen.palette.robotEdge;
    context.stroke();
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(x + radius * Math.cos(angle), y + radius * Math.sin(angle));
    context.stroke();
    pen.label([robot.x!, robot.y!], robot.name, radius + 14);
  }
}
