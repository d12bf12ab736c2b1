// SPDX-License-Identifier: Apache-2.0
// Lines of the velocity board's protocol, docs/velocity_board.md. Plain C++11 without any Arduino header.
#pragma once

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

namespace zenav {

const uint8_t MAX_LINE = 120;  // bytes; a longer line is noise

// Bits of the field `flags`.
enum Flag : uint16_t {
  BUMPER_LEFT = 0x001,
  BUMPER_FRONT = 0x002,
  BUMPER_RIGHT = 0x004,
  CLIFF_LEFT = 0x008,
  CLIFF_FRONT = 0x010,
  CLIFF_RIGHT = 0x020,
  ESTOP = 0x040,
  WATCHDOG = 0x080,
  MOTOR_FAULT = 0x100,
};

// CRC-16/XMODEM: polynomial 0x1021, initial value 0.
inline uint16_t crc16(const char* data, size_t n) {
  uint16_t crc = 0;
  for (size_t i = 0; i < n; ++i) {
    crc ^= (uint16_t)((uint8_t)data[i]) << 8;
    for (uint8_t bit = 0; bit < 8; ++bit) crc = crc & 0x8000 ? (uint16_t)(crc << 1) ^ 0x1021 : (uint16_t)(crc << 1);
  }
  return crc;
}

struct Command {
  uint16_t sequence;
  int32_t v;  // mm/s
  int32_t w;  // mrad/s, counter-clockwise
};

// What the board measures. battery: mV, or -1 if unknown. gyro: mrad/s, has_gyro false without a gyroscope.
struct Status {
  uint16_t sequence;
  uint32_t ms;
  uint16_t acknowledged;
  uint16_t flags;
  int32_t battery;
  bool has_gyro;
  int32_t gyro;
  int32_t left;   // ticks, rising when the robot drives forward
  int32_t right;
};

// Collects bytes to lines. feed() returns true when a byte completes a command with the right checksum.
class CommandReader {
 public:
  bool feed(char byte, Command* command) {
    if (byte != '\n' && byte != '\r') {
      if (byte == '$') n_ = 0;  // a line begins, whatever came before
      if (n_ < MAX_LINE) line_[n_++] = byte;
      return false;
    }
    const uint8_t n = n_;
    n_ = 0;
    return parse(n, command);
  }

 private:
  // $V,seq,v,w*CRCC
  bool parse(uint8_t n, Command* command) {
    if (n < 8 || n >= MAX_LINE || line_[0] != '$' || line_[n - 5] != '*') return false;
    char crc[5];
    snprintf(crc, sizeof crc, "%04X", (unsigned)crc16(line_ + 1, n - 6));
    if (memcmp(crc, line_ + n - 4, 4) != 0) return false;
    line_[n - 5] = '\0';
    if (line_[1] != 'V') return false;
    const char* at = line_ + 2;
    long values[3];
    for (uint8_t i = 0; i < 3; ++i) {
      if (*at != ',') return false;
      char* end;
      values[i] = strtol(at + 1, &end, 10);
      if (end == at + 1) return false;
      at = end;
    }
    if (*at != '\0') return false;
    command->sequence = (uint16_t)values[0];
    command->v = (int32_t)values[1];
    command->w = (int32_t)values[2];
    return true;
  }

  char line_[MAX_LINE];
  uint8_t n_ = 0;
};

// Writes the line of a status, with its end, into `out` (MAX_LINE + 1 bytes). Returns its length.
inline int write_status(const Status& s, char* out) {
  char battery[12] = "", gyro[12] = "";
  if (s.battery >= 0) snprintf(battery, sizeof battery, "%ld", (long)s.battery);
  if (s.has_gyro) snprintf(gyro, sizeof gyro, "%ld", (long)s.gyro);
  int n = snprintf(out, MAX_LINE, "$T,%u,%lu,%u,%X,%s,%s,%ld,%ld", (unsigned)s.sequence, (unsigned long)s.ms,
                   (unsigned)s.acknowledged, (unsigned)s.flags, battery, gyro, (long)s.left, (long)s.right);
  return n + snprintf(out + n, MAX_LINE - n, "*%04X\n", (unsigned)crc16(out + 1, n - 1));
}

// Whether a line follows another one, in numbers of 16 bits that wrap.
inline bool is_newer(uint16_t sequence, uint16_t before) {
  const uint16_t ahead = (uint16_t)(sequence - before);
  return ahead != 0 && ahead < 0x8000;
}

}  // namespace zenav
