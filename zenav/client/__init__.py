# SPDX-License-Identifier: Apache-2.0
"""The Python API for programs beside the stack: `from zenav.client import Client`."""

from shared.runners.client import Client

__all__ = ["Client"]
