# SPDX-License-Identifier: Apache-2.0
import shared.repeatable  # noqa: F401  # before numpy
from services.recorder.service import RecorderService
from services.recorder.store import RecordingStore
from shared.runners import live

if __name__ == "__main__":
    live.main(RecorderService, store=RecordingStore)
