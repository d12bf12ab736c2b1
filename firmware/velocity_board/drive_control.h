// SPDX-License-Identifier: Apache-2.0
// Commands to motor powers: watchdog, emergency stop, one PID controller for each wheel. Plain C++11, no Arduino header.
#pragma once

#include "protocol.h"

namespace zenav {

const uint32_t WATCHDOG_MS = 200;  // age of a command at which the motors stop

// The robot. Measure it; zenav calibrate refines radius and distance in the robot file, not here.
struct Wheels {
  float radius;          // m
  float distance;        // m between the wheels
  float ticks_per_turn;  // of the wheel
};

// Gains of the power (-1 to 1) by the speed of a rim, m/s. feed_forward: power for 1 m/s.
struct Gains {
  float feed_forward;
  float kp;
  float ki;
  float kd;
};

class Pid {
 public:
  float power(const Gains& gains, float target, float speed, float seconds) {
    const float error = target - speed;
    const float slope = seconds > 0 ? (error - error_) / seconds : 0;
    float out = gains.feed_forward * target + gains.kp * error + gains.ki * (integral_ + error * seconds) + gains.kd * slope;
    if (out > 1) out = 1;
    else if (out < -1) out = -1;
    else integral_ += error * seconds;  // no wind-up at full power
    error_ = error;
    return out;
  }

  void reset() { integral_ = error_ = 0; }

 private:
  float integral_ = 0, error_ = 0;
};

class DriveControl {
 public:
  DriveControl(const Wheels& wheels, const Gains& gains) : wheels_(wheels), gains_(gains) {}

  // Takes a command. One that is not newer than the last one is dropped, unless the watchdog has ended that.
  void take(const Command& command, uint32_t ms) {
    if (!has_expired(ms) && !is_newer(command.sequence, acknowledged_)) return;
    acknowledged_ = command.sequence;
    v_ = command.v * 1e-3f;
    w_ = command.w * 1e-3f;
    commanded_at_ = ms;
    has_command_ = true;
  }

  // Motor powers, -1 to 1, from the ticks of both wheels. Call it at a fixed rate. is_stopped: the e-stop is pressed.
  void update(int32_t left_ticks, int32_t right_ticks, uint32_t ms, bool is_stopped, float* left, float* right) {
    const float seconds = (ms - updated_at_) * 1e-3f;
    const float per_tick = 6.2831853f * wheels_.radius / wheels_.ticks_per_turn;
    const float left_speed = seconds > 0 ? (int32_t)(left_ticks - left_ticks_) * per_tick / seconds : 0;
    const float right_speed = seconds > 0 ? (int32_t)(right_ticks - right_ticks_) * per_tick / seconds : 0;
    left_ticks_ = left_ticks;
    right_ticks_ = right_ticks;
    updated_at_ = ms;
    if (is_stopped || has_expired(ms)) {
      has_command_ = false;  // neither a released e-stop nor the return of `ms` to 0 moves anything without a new command
      left_pid_.reset();
      right_pid_.reset();
      *left = *right = 0;
      return;
    }
    const float half = w_ * wheels_.distance / 2;
    *left = left_pid_.power(gains_, v_ - half, left_speed, seconds);
    *right = right_pid_.power(gains_, v_ + half, right_speed, seconds);
  }

  bool has_expired(uint32_t ms) const { return !has_command_ || ms - commanded_at_ >= WATCHDOG_MS; }
  uint16_t acknowledged() const { return acknowledged_; }

 private:
  Wheels wheels_;
  Gains gains_;
  Pid left_pid_, right_pid_;
  float v_ = 0, w_ = 0;
  uint32_t commanded_at_ = 0, updated_at_ = 0;
  int32_t left_ticks_ = 0, right_ticks_ = 0;
  uint16_t acknowledged_ = 0;
  bool has_command_ = false;
};

}  // namespace zenav
