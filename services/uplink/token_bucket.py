# SPDX-License-Identifier: Apache-2.0
"""Token bucket: a rate of bytes that bursts exceed for a short time only (Turner 1986)."""


class TokenBucket:
    """rate: bytes/s.  burst: s of the rate that may be spent at once after a pause. Times are s, monotonic."""

    def __init__(self, rate: float, burst: float) -> None:
        self.rate, self._burst = rate, burst
        self._tokens, self._at = rate * burst, float("-inf")

    def fill(self, now: float) -> None:
        """Adds what has come since the last call."""
        if now > self._at:
            gained = self.rate * (now - self._at)
            self._tokens, self._at = min(self._tokens + gained, self.rate * self._burst), now

    def spend(self, n_bytes: int) -> None:
        """Takes what was sent. The bucket may go below zero: then nothing more is due until it is filled."""
        self._tokens -= n_bytes

    @property
    def is_open(self) -> bool:
        """Whether something may be sent."""
        return self._tokens > 0

    @property
    def wait(self) -> float:
        """s until it is open."""
        return max(0.0, -self._tokens / self.rate)
