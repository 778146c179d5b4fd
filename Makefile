# make study   set-up, then the whole reference study on the twin into out/reference
# make test    set-up, then every check; the last line is pytest's summary
# A second call does only what its inputs ask for: pyproject.toml sets the packages,
# the C and C++ sources set the extensions.

PYTHON  ?= python3
VENV    := .venv
BIN     := $(VENV)/bin
PIP     := $(BIN)/python -m pip --disable-pip-version-check --quiet
OUT     ?= out/reference
WORKERS ?= 2
NATIVE  := CMakeLists.txt $(wildcard core/*.c core/include/*.h native/*.c native/*.h native/*.cpp)

.PHONY: help study test test-all setup lint ctest pytest tools bench clean
.DELETE_ON_ERROR:

help:
	@sed -n '1,2s/^# //p' Makefile
	@echo 'make lint    ruff, mypy, import-linter'
	@echo 'make ctest   the C core alone, under the sanitizers'
	@echo 'make bench   each figure that the project claims, beside its peers'
	@echo 'make setup   virtual environment and extensions only'
	@echo 'make clean   takes away $(VENV), build and caches; out stays'

study: setup
	$(BIN)/haselab reproduce --out $(OUT) --force

test: setup lint
	@$(MAKE) --no-print-directory pytest

test-all: setup lint tools
	$(BIN)/python -m pytest -n $(WORKERS)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --verbose

ctest: setup tools
	$(BIN)/python -m pytest tests/core

pytest: setup tools
	$(BIN)/python -m pytest -n $(WORKERS) -m 'not slow'

# The microcontrollers' compilers and simulators (that of ARM: 65 MB to fetch, 17 s, 550 MB). Where
# they cannot be had, their tests are skipped.
AVR := gcc-avr avr-libc libsimavr-dev libelf-dev cppcheck
ARM := --no-install-recommends gcc-arm-none-eabi qemu-user

tools:
	@{ command -v avr-gcc && test -e /usr/include/simavr/sim_avr.h; } >/dev/null || \
	  ( $(call APT,$(AVR)) ) || echo 'tests that need them are skipped' >&2
	@{ command -v arm-none-eabi-gcc && command -v qemu-arm; } >/dev/null || \
	  ( $(call APT,$(ARM)) ) || echo 'tests that need them are skipped' >&2

bench: setup $(VENV)/.bench
	$(BIN)/python benchmarks/bench.py

setup: $(VENV)/.built

# ---- set-up ---------------------------------------------------------------------------------

APT = if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    echo "installing $(1)" >&2; apt-get -qq update && apt-get -qq install -y $(1) >/dev/null; \
	  else echo 'missing: $(1). Type:  sudo apt-get install -y $(1)' >&2; exit 1; fi

$(VENV)/bin/python:
	@command -v $(PYTHON) >/dev/null || { $(call APT,python3 python3-venv python3-dev); }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo >&2 'haselab needs' \
	  'Python 3.11 or newer. Name one:  make PYTHON=python3.12 ...'; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { $(call APT,python3-venv python3-dev); }
	@$(PYTHON) -m venv $(VENV)

$(VENV)/.packages: pyproject.toml | $(VENV)/bin/python
	@command -v $${CXX:-c++} >/dev/null && command -v $${CC:-cc} >/dev/null || \
	  { $(call APT,gcc g++ libc6-dev); }
	@$(BIN)/python -c 'import os, sys, sysconfig as s; \
	  sys.exit(not os.path.exists(s.get_path("include") + "/Python.h"))' || \
	  { $(call APT,python3-dev); }
	@echo 'setup: packages'
	@$(PIP) install 'scikit-build-core>=0.11' 'nanobind>=2.7' 'cmake>=3.20' ninja 'setuptools>=70.1'
	@$(PIP) install --no-build-isolation --editable '.[formats,test,lint]'
	@touch $@ $(VENV)/.built

# scikit-build-core keeps its build folder, so this compiles what changed and nothing else.
$(VENV)/.built: $(NATIVE) $(VENV)/.packages
	@echo 'setup: extensions'
	@$(PIP) install --no-build-isolation --no-deps --editable .
	@touch $@

$(VENV)/.bench: pyproject.toml $(VENV)/.packages
	@$(PIP) install --no-build-isolation --editable '.[bench,peers]'
	@echo 'bench: peers of the transfer fit, which need an older numpy of their own'
	@$(BIN)/python -m venv $(VENV)/peers && $(VENV)/peers/bin/pip --disable-pip-version-check \
	  --quiet install sippy_unipi sysidentpy pysib control || \
	  echo 'bench: not all of them could be installed; the table shows the rest' >&2
	@touch $@

clean:
	rm -rf $(VENV) build .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
