# SPDX-License-Identifier: Apache-2.0
"""Without the package kiss-icp all but its registrar works, and the registrar says what it needs."""

import subprocess
import sys

import pytest

from services.mapper.front_end.kiss_registration import KissRegistrar
from services.mapper.front_end.registration import RegistrationConfig
from shared.config import UserError

EVERY_MODULE = """
import sys
sys.modules["kiss_icp"] = None  # any import of it raises
from importlib import import_module
from pkgutil import walk_packages
import services, shared, shared.repeatable, zenav
n = 0
for package in (services, shared, zenav):
    for module in walk_packages(package.__path__, package.__name__ + "."):
        if not module.name.endswith("__main__"):
            import_module(module.name)
            n += 1
assert n > 300, n
"""


def test_every_module_is_imported_without_the_package():
    done = subprocess.run([sys.executable, "-c", EVERY_MODULE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_registrar_without_its_package_says_how_to_get_it(monkeypatch):
    for name in ("kiss_icp", "kiss_icp.mapping", "kiss_icp.registration"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(UserError, match="kiss-icp") as error:
        KissRegistrar(RegistrationConfig(registrar="kiss"), 10.0)
    assert "pip install kiss-icp" in error.value.hint
