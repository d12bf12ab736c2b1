// SPDX-License-Identifier: Apache-2.0
// Reference firmware of a velocity board: two DC motors with quadrature encoders, on an Arduino Mega or a Raspberry Pi
// Pico (core arduino-pico). docs/velocity_board.md has the protocol, the wiring and the first start.
#include "drive_control.h"

using namespace zenav;

// --- edit this part ---------------------------------------------------------------------------------------------------

const Wheels WHEELS = {0.0325f, 0.150f, 1320.0f};  // radius m, distance m, ticks a turn of the wheel
const Gains GAINS = {1.4f, 2.0f, 6.0f, 0.0f};      // feed-forward 1.4: full power is about 0.7 m/s

#if defined(ARDUINO_ARCH_RP2040)
const int LEFT_A = 2, LEFT_B = 3, RIGHT_A = 4, RIGHT_B = 5;             // encoders
const int LEFT_PWM = 6, LEFT_IN1 = 7, LEFT_IN2 = 8;                     // motor driver, as TB6612FNG or L298N
const int RIGHT_PWM = 9, RIGHT_IN1 = 10, RIGHT_IN2 = 11;
const int ESTOP_PIN = 12, BUMPER_LEFT_PIN = 13, BUMPER_RIGHT_PIN = 14;  // switches to ground
const int BATTERY_PIN = 26;
const float BATTERY_MV = 3300.0f * 5.0f / 1023.0f;  // mV for a step of the converter: divider 5:1, 10 bits
#else
const int LEFT_A = 18, LEFT_B = 22, RIGHT_A = 19, RIGHT_B = 23;
const int LEFT_PWM = 5, LEFT_IN1 = 24, LEFT_IN2 = 25;
const int RIGHT_PWM = 6, RIGHT_IN1 = 26, RIGHT_IN2 = 27;
const int ESTOP_PIN = 2, BUMPER_LEFT_PIN = 3, BUMPER_RIGHT_PIN = 4;
const int BATTERY_PIN = A0;
const float BATTERY_MV = 5000.0f * 3.0f / 1023.0f;  // divider 3:1
#endif
const int LEFT_DIRECTION = 1, RIGHT_DIRECTION = 1;  // -1 where a wheel turns, or counts, the wrong way

// ----------------------------------------------------------------------------------------------------------------------

const uint32_t PERIOD_MS = 20;  // of the controller and of the status lines

DriveControl control(WHEELS, GAINS);
CommandReader reader;
volatile int32_t left_ticks = 0, right_ticks = 0;

// Two ticks a period of channel A: the direction is what channel B says at each edge.
void left_edge() { left_ticks += digitalRead(LEFT_A) == digitalRead(LEFT_B) ? -1 : 1; }
void right_edge() { right_ticks += digitalRead(RIGHT_A) == digitalRead(RIGHT_B) ? -1 : 1; }

void set_motor(int pwm, int in1, int in2, float power) {
  digitalWrite(in1, power > 0 ? HIGH : LOW);
  digitalWrite(in2, power < 0 ? HIGH : LOW);
  analogWrite(pwm, (int)(255 * (power < 0 ? -power : power)));
}

void setup() {
  const int inputs[] = {LEFT_A, LEFT_B, RIGHT_A, RIGHT_B, ESTOP_PIN, BUMPER_LEFT_PIN, BUMPER_RIGHT_PIN};
  for (int pin : inputs) pinMode(pin, INPUT_PULLUP);
  const int outputs[] = {LEFT_PWM, LEFT_IN1, LEFT_IN2, RIGHT_PWM, RIGHT_IN1, RIGHT_IN2};
  for (int pin : outputs) pinMode(pin, OUTPUT);
  attachInterrupt(digitalPinToInterrupt(LEFT_A), left_edge, CHANGE);
  attachInterrupt(digitalPinToInterrupt(RIGHT_A), right_edge, CHANGE);
  Serial.begin(115200);
}

void loop() {
  static uint32_t last = 0;
  static uint16_t sequence = 0;
  Command command;
  while (Serial.available()) {
    if (reader.feed((char)Serial.read(), &command)) control.take(command, millis());
  }
  const uint32_t now = millis();
  if (now - last < PERIOD_MS) return;
  last = now;

  noInterrupts();
  const int32_t left = LEFT_DIRECTION * left_ticks, right = RIGHT_DIRECTION * right_ticks;
  interrupts();
  // The e-stop's contact is normally closed: a cut cable stops the robot, too.
  const bool is_stopped = digitalRead(ESTOP_PIN) == HIGH;
  float left_power, right_power;
  control.update(left, right, now, is_stopped, &left_power, &right_power);
  set_motor(LEFT_PWM, LEFT_IN1, LEFT_IN2, LEFT_DIRECTION * left_power);
  set_motor(RIGHT_PWM, RIGHT_IN1, RIGHT_IN2, RIGHT_DIRECTION * right_power);

  Status status = {};
  status.sequence = ++sequence;
  status.ms = now;
  status.acknowledged = control.acknowledged();
  if (is_stopped) status.flags |= ESTOP;
  if (control.has_expired(now)) status.flags |= WATCHDOG;
  if (digitalRead(BUMPER_LEFT_PIN) == LOW) status.flags |= BUMPER_LEFT;
  if (digitalRead(BUMPER_RIGHT_PIN) == LOW) status.flags |= BUMPER_RIGHT;
  status.battery = (int32_t)(analogRead(BATTERY_PIN) * BATTERY_MV);
  status.left = left;
  status.right = right;
  char line[MAX_LINE + 1];
  Serial.write(line, write_status(status, line));
}
