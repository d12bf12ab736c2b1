// SPDX-License-Identifier: Apache-2.0
// The reference firmware on a computer: the sketch's loop with motors of the first order, one line in and out a period.
// In: "HEX ESTOP MS": the bytes that arrived, 0 or 1, and ms that pass before. Out: the bytes of the status line.
#include <math.h>

#include <iostream>
#include <string>

#include "drive_control.h"

using namespace zenav;

int main(int argc, char** argv) {
  const Wheels wheels = {0.0325f, 0.150f, 1320.0f};
  const Gains gains = {1.4f, 2.0f, 6.0f, 0.0f};
  DriveControl control(wheels, gains);
  CommandReader reader;
  const double max_rim = 0.65, lag = 0.08, period = 0.02, per_tick = 6.283185307179586 * wheels.radius / wheels.ticks_per_turn;
  double travel[2] = {0, 0}, speed[2] = {0, 0};
  const int32_t first = argc > 1 ? (int32_t)strtol(argv[1], nullptr, 10) : 0;  // the counters' first value
  uint32_t ms = 0;
  uint16_t sequence = 0;
  std::string line;
  while (std::getline(std::cin, line)) {
    const size_t space = line.find(' ');
    const bool is_stopped = line[space + 1] == '1';
    ms += (uint32_t)std::stoul(line.substr(space + 3));
    Command command;
    for (size_t i = 0; i + 1 < space; i += 2) {
      if (reader.feed((char)std::stoi(line.substr(i, 2), nullptr, 16), &command)) control.take(command, ms);
    }
    ms += 20;
    int32_t ticks[2];
    for (int i = 0; i < 2; ++i) ticks[i] = (int32_t)((uint32_t)first + (uint32_t)(int32_t)floor(travel[i] / per_tick));
    float power[2];
    control.update(ticks[0], ticks[1], ms, is_stopped, &power[0], &power[1]);
    for (int i = 0; i < 2; ++i) {
      speed[i] += (power[i] * max_rim - speed[i]) * (1 - exp(-period / lag));
      travel[i] += speed[i] * period;
    }
    Status status = {};
    status.sequence = ++sequence;
    status.ms = ms;
    status.acknowledged = control.acknowledged();
    status.flags = (is_stopped ? ESTOP : 0) | (control.has_expired(ms) ? WATCHDOG : 0);
    status.battery = 7400;
    status.left = ticks[0];
    status.right = ticks[1];
    char out[MAX_LINE + 1];
    const int n = write_status(status, out);
    std::cout << std::string(out, n) << std::flush;
  }
}
