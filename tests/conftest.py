# SPDX-License-Identifier: Apache-2.0
"""Before anything imports numpy."""

import shared.repeatable  # noqa: F401
