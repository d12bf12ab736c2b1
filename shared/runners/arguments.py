# SPDX-License-Identifier: Apache-2.0
"""Inputs of a service process at its start: its command line, and what its parent has preloaded."""

import argparse

PRELOADED: set[str] = set()
"""Services whose kernels are loaded, because the process that forked this one did that."""


def arguments(name: str) -> argparse.ArgumentParser:
    """The options of every service's process."""
    parser = argparse.ArgumentParser(prog=f"zenav run {name}", description=f"Runs {name} alone, in the foreground.")
    parser.add_argument("--robot", default="x80sv", help="name of a robot, or a YAML file")
    parser.add_argument("--stack", default="0", help="number of the stack on this host, or a router: tcp/router:7447")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override a setting")
    parser.add_argument("--clock", default="", metavar="EPOCH:SPEED", help="simulated time: ns, times as fast as real")
    parser.add_argument("--memory", default="", metavar="FOLDER", help="keep what a restart must not lose, as the map")
    parser.add_argument("--crashes", default="recordings", metavar="FOLDER", help="where crash-NAME-STAMP.mcap goes")
    parser.add_argument("--log", default="INFO", choices=["DEBUG", "INFO", "WARNING", "ERROR"], help="log level")
    return parser
