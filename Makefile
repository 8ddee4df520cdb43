# `make help` lists the targets. All of them work in .venv, which is made when it is missing.

VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
INSTALLED_BENCH := $(VENV)/.installed-bench
DOCS_VENV := .venv-docs
REACHY_VENV := .venv-reachy

# The pins in constraints.txt are for Python 3.11; a newer one is taken where there is no 3.11.
ifeq ($(origin PYTHON),undefined)
PYTHON := $(shell for p in python3.11 python3; do $$p -c '' 2>/dev/null && echo $$p && break; done)
endif

export PIP_DISABLE_PIP_VERSION_CHECK := 1
export MPLBACKEND := Agg

# Compiled on all cores, which pip does not do; and where Python is told to write no bytecode, every
# command would otherwise compile all that it imports anew, for seconds. Some packages carry files that
# are no Python, which is no error here.
PIP_INSTALL := $(BIN)/python -m pip install -qq --no-compile -c constraints.txt
COMPILE := $(BIN)/python -m compileall -qq -j 0 $(VENV)/lib >/dev/null || true

.DEFAULT_GOAL := help
.PHONY: generate demo docs test slow board lint format-check types wheel newest bench reachy soak clean help

demo: $(INSTALLED)  ## the paper's comparison, from rest, on the reference, and with a delay of 0.8 s believed to be 0.6 s
	$(BIN)/stewart-drake compare paper --out out/demo/rest
	$(BIN)/stewart-drake compare paper --set start=on_reference --set queue=reference \
		--out out/demo/on_reference
	$(BIN)/stewart-drake compare paper --set controller.delay_steps=6 --out out/demo/wrong_delay
	@echo "open out/demo/rest/states.png; on_reference and wrong_delay have the same"

# The package is read, not imported: what builds the site is all that is needed.
docs: $(DOCS_VENV)/.installed  ## the documentation as a site with search, in out/site; warnings are errors
	@NO_MKDOCS_2_WARNING=1 $(DOCS_VENV)/bin/mkdocs build --strict
	@echo "open out/site/index.html"

# Workers of one thread each, so that they do not fight over the processor.
# Each takes a stretch of the files, so that what their tests share is made once, and who is done
# takes from the other.
WORKERS := -n logical --maxprocesses 4 --dist worksteal
test slow board soak bench reachy: export OMP_NUM_THREADS := 1
test slow board soak bench reachy: export OPENBLAS_NUM_THREADS := 1
# Tests start commands, and each would compile all of the package anew.
test slow board soak: export PYTHONDONTWRITEBYTECODE :=

test: $(INSTALLED)  ## the tests but for the slow ones; ARGS="..." is handed to pytest
	$(BIN)/pytest $(WORKERS) $(ARGS)

# Many wait for machines and browsers in real time: two workers a core.
slow: $(INSTALLED)  ## the slow ones: whole commands, documents and processes
	$(BIN)/pytest $(WORKERS) -n $$((2 * $$(nproc --all))) -m "slow and not soak" $(ARGS)

board: $(INSTALLED)  ## exported controllers on emulated Cortex-M processors; their table in docs/howto/board.md
	$(BIN)/python -m tests.board.run

soak: $(INSTALLED)  ## the endurance runs
	$(BIN)/pytest $(WORKERS) -m soak -o faulthandler_timeout=0 $(ARGS)

lint: $(INSTALLED)  ## ruff's rules, and those of imports between rooms
	$(BIN)/ruff check .
	$(BIN)/lint-imports --no-cache --no-logo

format-check: $(INSTALLED)  ## ruff's format, without changing a file
	$(BIN)/ruff format --check .

types: $(INSTALLED)  ## mypy, strict
	$(BIN)/mypy

wheel:  ## builds the wheel and tries it in a clean environment, from an empty folder
	@PYTHON=$(PYTHON) bash .ci/wheel

newest:  ## the tests with the newest Drake, on Python 3.12 or later, without torch
	@bash .ci/newest $(ARGS)

reachy: $(INSTALLED) $(REACHY_VENV)/.installed  ## Reachy Mini's own daemon in simulation, moved over a network like Wi-Fi
	REACHY_DAEMON=$(REACHY_VENV)/bin/reachy-mini-daemon $(BIN)/python benchmarks/reachy_daemon.py

# Without arguments a script runs all of its sections.
bench: export QUICK := $(QUICK)
bench: $(INSTALLED_BENCH)  ## every script in benchmarks/; QUICK=1: at the least size, pages in out/bench
	@failed=; for script in $(sort $(wildcard benchmarks/[a-z]*.py)); do \
		echo "== $$script"; $(BIN)/python $$script || failed="$$failed $$script"; \
	done; test -z "$$failed" || { echo "failed:$$failed"; exit 1; }

generate: $(INSTALLED)  ## writes equations.h and models/*.sdf anew, and compiles the core
	$(BIN)/python -m stewart_drake.dynamics.generate
	$(BIN)/python -m stewart_drake.core.build

clean:  ## removes builds, caches and the demo's output, keeps the environments
	rm -rf build dist out/demo out/site .pytest_cache .hypothesis .mypy_cache .ruff_cache
	find . -path ./$(VENV) -prune -o -type d -name __pycache__ -exec rm -rf {} +

help:  ## this list
	@awk 'BEGIN {FS = ":.*  ## "} /^[a-z-]+:.*  ## / {printf "make %-13s %s\n", $$1, $$2}' Makefile

# The installation compiles the core, and first generates what is not committed. A library that is
# older than its source is refused.
EQUATIONS := stewart_drake/core/equations.h
$(INSTALLED): pyproject.toml constraints.txt hatch_build.py \
		$(filter-out $(EQUATIONS),$(wildcard stewart_drake/core/*.[ch]))
	@test -n "$(PYTHON)" || { echo "no Python found: set PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "$(PYTHON) is too old: set PYTHON to a Python 3.11 or newer"; exit 1; }
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv $(VENV)
	@echo "installing stewart-drake and its dependencies into $(VENV) (a few minutes the first time)"
	@$(PIP_INSTALL) -e '.[train,dev]'
	@$(COMPILE)
	@touch $@

$(DOCS_VENV)/.installed: pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "no Python found: set PYTHON=/path/to/python3.11"; exit 1; }
	@echo "installing what builds the documentation into $(DOCS_VENV)"
	@$(PYTHON) -m venv $(DOCS_VENV)
	@$(DOCS_VENV)/bin/python -m pip install -qq -c constraints.txt $$($(PYTHON) -c 'import tomllib; \
		print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["docs"])')
	@touch $@

# The robot's package asks for more than its daemon needs in simulation, such as cameras.
REACHY_DEBIAN := libcairo2-dev libgirepository1.0-dev pkg-config gstreamer1.0-plugins-base \
	gir1.2-gstreamer-1.0 gir1.2-gst-plugins-base-1.0 gir1.2-gst-plugins-bad-1.0
REACHY_PACKAGES := 'PyGObject<=3.46' 'websockets<16' 'huggingface-hub<2' mujoco==3.3.0 fastapi uvicorn \
	aiohttp asgiref scipy pydantic toml psutil jinja2 requests python-multipart zeroconf questionary \
	platformdirs pyserial pyusb libusb_package onnxruntime rich rustypot
$(REACHY_VENV)/.installed:
	@pkg-config --exists cairo gobject-introspection-1.0 || \
		{ echo "missing Debian packages: expected $(REACHY_DEBIAN)"; exit 1; }
	@echo "installing reachy-mini and what its daemon needs into $(REACHY_VENV)"
	@$(PYTHON) -m venv $(REACHY_VENV)
	@$(REACHY_VENV)/bin/python -m pip install -qq --no-deps reachy-mini==1.13.0 \
		reachy-mini-rust-kinematics reachy_mini_motor_controller log-throttling==0.0.3
	@$(REACHY_VENV)/bin/python -m pip install -qq $(REACHY_PACKAGES)
	@$(REACHY_VENV)/bin/reachy-mini-daemon --help >/dev/null || \
		{ echo "missing Debian packages: expected $(REACHY_DEBIAN)"; exit 1; }
	@touch $@

$(INSTALLED_BENCH): $(INSTALLED)
	@echo "installing what only the benchmarks need"
	@$(PIP_INSTALL) -e '.[bench]'
	@$(COMPILE)
	@touch $@
