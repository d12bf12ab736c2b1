# SPDX-License-Identifier: Apache-2.0
import shared.repeatable  # noqa: F401  # before numpy
from services.mapper.service import MapperService
from shared.runners import live

if __name__ == "__main__":
    live.main(MapperService)
