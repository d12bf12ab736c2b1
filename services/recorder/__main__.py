# SPDX-License-Identifier: Apache-2.0
import shared.repeatable  # noqa: F401  # before numpy
from services.recorder.recording_store import RecordingStore
from services.recorder.service import RecorderService
from shared.runners import live

if __name__ == "__main__":
    live.main(RecorderService, store=RecordingStore)
