# SPDX-License-Identifier: Apache-2.0
SHELL := /bin/bash
.ONESHELL:
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.PHONY: help venv demo test test-docker test-ros2 test-systemd test-wheel mutants check fix lock verify-lock sbom docs figures record-references screenshots warm web web-check wheel clean

PYTHON ?=
JOBS ?= 3 # one more than two cores: who tests processes waits half of the time
BIN := .venv/bin
# the tests and the demo start hundreds of processes, which would all compile the code again
unexport PYTHONDONTWRITEBYTECODE
KERNELS := $(shell find services shared -name '*.py')

# what makes mutants: the rest of cosmic-ray's 22 packages is for its own runner, which is not used
MUTATORS := cosmic-ray==8.7.0 parso==0.8.7 attrs==26.1.0

# what judges the bridge to ROS 2: an independent rmw_zenoh node, and the decoder of ROS itself; in an environment of its own
ROS2_PEERS := zenoh-ros2-sdk==0.1.8 ros-jazzy-rclpy==7.1.6 ros-jazzy-rmw-fastrtps-cpp==8.4.3 ros-jazzy-sensor-msgs==5.3.6 \
  ros-jazzy-nav-msgs==5.3.6 ros-jazzy-geometry-msgs==5.3.6 ros-jazzy-std-srvs==5.3.6 ros-jazzy-action-msgs==2.0.3 \
  ros-jazzy-diagnostic-msgs==5.3.6 ros-jazzy-visualization-msgs==5.3.6

# what makes requirements.hashes.txt and the list of software; they run in environments of their own
HASHER := pip-tools==7.6.2
LISTER := cyclonedx-bom==7.5.0

# real logs and benchmark worlds, for the tests that use them; they skip where there are none
ZENAV_DATA ?= $(shell cd ../shared/data 2>/dev/null && pwd)
ifneq ($(ZENAV_DATA),)
export ZENAV_DATA
endif

help: ## this list
	@sed -n 's/^\([a-z0-9-]*\):.*## \(.*\)/  make \1\t\2/p' Makefile | column -t -s $$'\t'

venv: .venv/.warm ## .venv with everything pinned, and the kernels compiled

demo: venv ## the whole stack explores an office and drives to its goals: make demo ARGS="--headless"
	@$(BIN)/zenav demo $(ARGS)

test: venv ## everything that needs no Docker: make test ARGS="-k planner"
	@$(BIN)/python -m pytest -n $(JOBS) --ignore tests/docker --ignore tests/ros2 --ignore tests/systemd --ignore tests/wheel $(ARGS)

test-docker: venv ## the Compose file on a real engine
	@$(BIN)/python -m pytest tests/docker -rs $(ARGS)

test-ros2: venv .venv-ros2/.made ## the bridge beside ROS 2's own decoder and an independent node; x86-64, needs a package index
	@$(BIN)/python -m pytest -n0 tests/ros2 -rs $(ARGS)

.venv-ros2/.made: Makefile
	@$(BIN)/python -m venv .venv-ros2
	.venv-ros2/bin/python -m pip install -q --disable-pip-version-check $(ROS2_PEERS)
	touch $@

test-systemd: venv ## the installed service under a real systemd, in namespaces of its own; needs root
	@$(BIN)/python -m pytest -n0 tests/systemd -rs $(ARGS)

test-wheel: .venv/.made ## the wheel in an empty environment, some minutes; needs a package index
	@$(BIN)/python -m pytest -n0 tests/wheel -rs $(ARGS)

mutants: venv ## a test fails for each small change of the wheels' equations and the codec: make mutants ARGS="codec"
	@work=$$(mktemp -d); trap 'rm -rf "$$work"' EXIT
	$(BIN)/python -m pip install -q --disable-pip-version-check --no-deps --target "$$work" $(MUTATORS)
	PYTHONPATH="$$work" $(BIN)/python -m tests.mutants $(ARGS)

check: venv ## lint, format, types, architecture, language
	@status=0
	run() {
	  local name=$$1 dots='................................' output; shift
	  printf '%s' "$$name$${dots:$${#name}}"
	  if output=$$("$$@" 2>&1); then echo '[ok]'; else echo '[failed]'; echo "$$output"; status=1; fi
	}
	run lint $(BIN)/ruff check .
	run format $(BIN)/ruff format --check .
	run types $(BIN)/mypy
	run imports $(BIN)/lint-imports --no-cache
	run architecture $(BIN)/python -m pytest --tb=short -rN tests/test_architecture.py tests/test_docs.py
	run language $(BIN)/python -m pytest --tb=short -rN tests/test_language.py
	exit $$status

fix: venv ## repair what a tool can: lint, format, generated docs
	@$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/python -m zenav.docs
	$(BIN)/python -m zenav.web_types

docs: venv ## write docs/messages.md, docs/configuration.md, the tables of figures and the page's types
	@$(BIN)/python -m zenav.docs
	$(BIN)/python -m zenav.web_types

figures: venv ## rerun the published figures, some hours, resumable: make figures ARGS="--only sim,odometry"
	@$(BIN)/zenav bench figures $(ARGS)

record-references: venv ## run the stack again for the recordings that the replay tests compare with
	@$(BIN)/python -m tests.replay.record $(ARGS)

screenshots: venv ## pictures of the page for the README, from Chromium: docs/images/page*.png
	@$(BIN)/python -m tests.page.screenshots

warm: ## compile the kernels again where the code changed
	@$(BIN)/python -m zenav.stack.warm

web: ## check, test and bundle the page into services/dashboard/static; needs Node 20, users do not
	@cd web
	npm ci
	npm run lint
	npm test
	npm run build

web-check: web ## the committed bundle is what its sources make
	@git diff --exit-code --stat -- services/dashboard/static

lock: ## write requirements*.txt again from pyproject.toml, with the newest versions that it allows
	@work=$$(mktemp -d); trap 'rm -rf "$$work"' EXIT
	$(find_python)
	"$$python" -m venv "$$work/venv"
	"$$work/venv/bin/pip" install -q --upgrade pip setuptools
	for extra in '' '[dev]'; do
	  "$$work/venv/bin/pip" install -q ".$$extra"
	  "$$work/venv/bin/pip" freeze --all --exclude zenav --exclude pip --exclude wheel > "$$work/lock$$extra"
	done
	setuptools=$$(grep '^setuptools==' "$$work/lock")
	{ echo '# What runs the robot. Written by `make lock`; the pins hold for Python 3.11 to 3.13.'
	  cat "$$work/lock"; } > requirements.txt
	{ echo '# What tests and checks it, on top. Written by `make lock`.'; echo '-r requirements.txt'
	  comm -13 <(sort "$$work/lock") <(sort "$$work/lock[dev]"); } > requirements-dev.txt
	rm -rf build zenav.egg-info
	"$$python" -m venv "$$work/hasher"
	"$$work/hasher/bin/pip" install -q $(HASHER)
	"$$work/hasher/bin/pip-compile" -q --generate-hashes --allow-unsafe --strip-extras --no-header --no-annotate \
	  --no-emit-options -o "$$work/hashes" requirements.txt
	{ echo '# The same with the hashes of every file, for pip install --require-hashes. Written by `make lock`.'
	  cat "$$work/hashes"; } > requirements.hashes.txt

verify-lock: ## install requirements.hashes.txt into an empty environment, each file compared with its hash
	@work=$$(mktemp -d); trap 'rm -rf "$$work"' EXIT
	$(find_python)
	"$$python" -m venv "$$work/venv"
	"$$work/venv/bin/pip" install -q --disable-pip-version-check --no-deps --require-hashes -r requirements.hashes.txt
	"$$work/venv/bin/pip" check

sbom: venv ## the list of software of requirements.hashes.txt, CycloneDX 1.6: dist/zenav.cdx.json; needs a package index
	@work=$$(mktemp -d); trap 'rm -rf "$$work"' EXIT
	$(find_python)
	"$$python" -m venv "$$work/venv"
	"$$work/venv/bin/pip" install -q --disable-pip-version-check $(LISTER)
	list() { "$$work/venv/bin/cyclonedx-py" "$$@" --spec-version 1.6 --output-reproducible 2> "$$work/log" || { cat "$$work/log"; exit 1; }; }
	list requirements requirements.hashes.txt -o "$$work/requirements.json"
	list environment .venv -o "$$work/environment.json"
	$(BIN)/python -m tests.sbom "$$work/requirements.json" "$$work/environment.json" dist/zenav.cdx.json

wheel: venv ## the wheel, with the kernels of this kind of computer, and the source distribution: in dist/
	@rm -rf dist build zenav/prebuilt_kernels.zip
	trap 'rm -rf build zenav/prebuilt_kernels.zip zenav.egg-info' EXIT
	# setuptools of .venv, as pinned; a warning of it is an error's first half, so it is shown
	$(BIN)/python -c 'from setuptools.build_meta import build_sdist; build_sdist("dist")' > /dev/null
	env -u NUMBA_CACHE_DIR $(BIN)/python -m zenav.stack.warm zenav/prebuilt_kernels.zip
	$(BIN)/python -c 'from setuptools.build_meta import build_wheel; build_wheel("dist")' > /dev/null
	ls dist

clean: ## remove all that was made, .venv too
	@rm -rf .venv .venv-ros2 build dist out *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +

define find_python
	python='' without_venv=''
	for candidate in $(if $(PYTHON),"$(PYTHON)",python3.13 python3.12 python3.11 python3); do
	  "$$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' 2>/dev/null || continue
	  if "$$candidate" -c 'import ensurepip, venv' 2>/dev/null; then python=$$candidate; break; fi
	  without_venv=$${without_venv:-$$candidate}
	done
	if [[ -z $$python && -n $$without_venv ]]; then
	  echo "$$without_venv cannot make virtual environments" >&2
	  echo "hint: sudo apt install $${without_venv##*/}-venv" >&2; exit 1
	elif [[ -z $$python ]]; then
	  echo "no Python 3.11, 3.12 or 3.13 here (python3 is $$(python3 --version 2>/dev/null || echo missing))" >&2
	  echo "hint: sudo apt install python3 python3-venv, or name one: make venv PYTHON=/path/to/python3.12" >&2; exit 1
	fi
endef

.venv/.made: pyproject.toml requirements.txt requirements-dev.txt
	@$(find_python)
	if ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
	  echo "making .venv with $$("$$python" --version)"
	  rm -rf .venv; "$$python" -m venv .venv
	fi
	.venv/bin/python -m pip install -q --disable-pip-version-check -r requirements-dev.txt
	.venv/bin/python -m pip install -q --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

.venv/.warm: .venv/.made $(KERNELS)
	@$(BIN)/python -m zenav.stack.warm
	touch $@
